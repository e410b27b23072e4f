"""Evaluation: held-out scores, sharpness, body coverage."""

"""Baking: a trained field sampled into tables and fine-tuned."""

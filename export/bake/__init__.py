"""Baking: the field sampled into tables, and fine-tuned."""

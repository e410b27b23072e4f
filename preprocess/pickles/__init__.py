"""Pickles of strangers: what they hold, read without running any of it."""

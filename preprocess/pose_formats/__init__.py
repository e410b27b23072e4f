"""Adapters: one module per program whose pose files are read."""

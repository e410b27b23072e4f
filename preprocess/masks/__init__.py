"""Masks: read, checked or estimated."""

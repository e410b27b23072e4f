"""Masks: out of files of every kind, while they are written, or made from body and picture."""

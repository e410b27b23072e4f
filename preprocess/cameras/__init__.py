"""Cameras: one reader per format."""

"""Poses: files, units, gaps and placement in the world."""

"""Fitting of one person's proportions, camera and poses to the outlines of masks."""

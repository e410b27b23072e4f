"""Baselines: other methods, and kernels and player stated plainly; never imported by production."""

"""Baselines: other methods, trained and scored beside ours; never imported by production code."""

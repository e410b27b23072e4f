"""A run: its folder, training session and results."""

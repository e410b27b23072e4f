"""Training: from observations to a trained avatar."""

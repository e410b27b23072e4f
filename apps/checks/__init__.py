"""ia-check: validate a capture before training."""

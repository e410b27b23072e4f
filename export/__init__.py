"""Export: an avatar that plays without torch."""

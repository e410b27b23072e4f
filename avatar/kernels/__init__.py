"""The operations of a training step: a plain torch meaning, and twins that are fast."""

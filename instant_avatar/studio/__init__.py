"""The studio: renders synthetic captures of an actor, with ground truth."""

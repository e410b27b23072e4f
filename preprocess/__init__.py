"""Preprocess: what is known about each frame, as a mask, a body pose and a camera."""

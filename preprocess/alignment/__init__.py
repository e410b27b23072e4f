"""Alignment of body, poses and cameras to masks and images."""

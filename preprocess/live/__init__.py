"""Poses, masks and alignment of a live source."""

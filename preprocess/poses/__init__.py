"""Poses: one adapter for each tracker's files, and one door to all of them."""

from preprocess.poses.door import read_poses as read_poses

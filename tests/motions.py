"""Motions of a few lines for tests: what they leave out is at rest, valid, and of no shape."""

from typing import Any

import numpy as np

from preprocess.body.body_pose import Motion
from preprocess.tracking.keypoints import KeypointTrack


def make_motion(
    roots: np.ndarray,
    places: np.ndarray | None = None,
    joints: np.ndarray | None = None,
    model: str = "body24",
    **others: Any,
) -> Motion:
    """A motion of root rotations, root translations and joint rotations."""
    count = len(roots)
    usual = {"valid": np.ones(count, dtype=bool), "betas": np.zeros(10)}
    places = np.zeros((count, 3)) if places is None else places
    joints = np.zeros((count, 23, 3)) if joints is None else joints
    parts = {"root_rotations": roots, "root_translations": places, "joint_rotations": joints}
    return Motion(**parts, body_model=model, **(usual | others))


def make_track(frames: np.ndarray, size_px: tuple[int, int], **others: Any) -> KeypointTrack:
    """Key points of frames, which are all seen, in one place."""
    count = len(frames)
    usual = {"image_px": np.zeros((count, 33, 2)), "world_m": np.zeros((count, 33, 3))}
    usual |= {"visibility": np.ones((count, 33)), "presence": np.ones(count)}
    return KeypointTrack(frames=frames, size_px=size_px, **(usual | others))

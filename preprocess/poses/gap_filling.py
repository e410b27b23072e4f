"""Fill short gaps in a motion between their neighbors, and mark the filled rows."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from preprocess.body.body_pose import Motion
from preprocess.body.rotations import slerp

MAX_GAP_FRAMES = 12
"""Longest gap that is filled, frames: half a second at 24 Hz."""


def fill_gaps(motion: Motion, max_gap: int = MAX_GAP_FRAMES) -> Motion:
    """The motion with short gaps filled in: slerp for rotations, straight lines for places.

    A gap is a run of frames without a valid row between two frames with one; longer gaps stay.
    Motions without frame numbers are taken as one row a frame. Those with cameras of their own are
    bridged only where each frame has its row, and so its camera.

    Args:
        motion: One row a frame at most.
        max_gap: Longest gap that is filled, frames.
    """
    if motion.camera_from_world is not None and motion.frames is not None:
        return motion  # the cameras of the missing frames are unknown
    numbers = motion.frames if motion.frames is not None else np.arange(len(motion))
    good = np.flatnonzero(motion.valid)
    before = good[:-1][(np.diff(numbers[good]) > 1) & (np.diff(numbers[good]) <= max_gap + 1)]
    if not len(before):
        return motion
    filled = [
        _fill_gap(motion, numbers, int(row), int(good[np.searchsorted(good, row) + 1]))
        for row in before
    ]
    new = np.concatenate([part[0] for part in filled])
    kept = ~np.isin(numbers, new)
    order = np.argsort(np.concatenate([numbers[kept], new]), kind="stable")

    def merged(old: np.ndarray, added: np.ndarray) -> np.ndarray:
        return np.concatenate([old[kept], added])[order]

    rotations = np.concatenate([part[1] for part in filled])
    times_s = motion.times_s
    if times_s is not None:
        times_s = np.interp(merged(numbers, new), numbers[good], times_s[good])
    return replace(
        motion,
        root_rotations=merged(motion.root_rotations, rotations[:, 0]),
        root_translations=merged(
            motion.root_translations, np.concatenate([part[2] for part in filled])
        ),
        joint_rotations=merged(motion.joint_rotations, rotations[:, 1:]),
        valid=merged(motion.valid, np.ones(len(new), dtype=bool)),
        frames=merged(numbers, new) if motion.frames is not None else None,
        times_s=times_s,
        interpolated=merged(np.zeros(len(numbers), dtype=bool), np.ones(len(new), dtype=bool)),
    )


def _fill_gap(
    motion: Motion, numbers: Int[np.ndarray, "poses"], row: int, after: int
) -> tuple[Int[np.ndarray, "gap"], Float[np.ndarray, "gap 24 3"], Float[np.ndarray, "gap 3"]]:
    """Frame numbers, rotations and places between two rows."""
    new = np.arange(numbers[row] + 1, numbers[after])
    shares = (new - numbers[row]) / (numbers[after] - numbers[row])
    first, last = (
        np.concatenate([motion.root_rotations[i][None], motion.joint_rotations[i]])
        for i in (row, after)
    )
    places = motion.root_translations[row] + shares[:, None] * (
        motion.root_translations[after] - motion.root_translations[row]
    )
    return new, slerp(first, last, shares), places

"""One person's poses, put together from what a tracker's file calls them; short gaps are filled."""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from preprocess.body.body_pose import Motion, PoseSpace, RelativeFocalLength, RootAnchor
from preprocess.body.kinematics import slerp, stack_axis_angles

MotionByPerson = dict[str, Motion]
"""By the name that the file gives each, in the file's order."""


def build_motion(
    rotations: list[Any],
    translations: Any,
    *,
    betas: Any = None,
    frames: Any = None,
    times_s: Float[np.ndarray, "poses"] | None = None,
    lost: Any = None,
    body_model: str = "smpl",
    space: PoseSpace = "camera",
    anchor: RootAnchor = "pelvis",
    lens: Any = None,
) -> Motion:
    """Poses of one person, rows in the order of their frames.

    Args:
        rotations: What holds the rotations, root first; see `joint_rotations`.
        translations: Where the root is, one row a pose, metres.
        betas: One row, or one row a pose: then their median.
        frames: The frames' numbers; of a number that comes twice the first row counts.
        times_s: Times in seconds.
        lost: Which rows the tracker itself calls lost.
        body_model, space, anchor: See `Motion`.
        lens: The camera matrix K, or one per pose; or the focal length that the tracker assumed.

    Raises:
        ValueError: If the parts do not fit together.
    """
    is_assumed = isinstance(lens, RelativeFocalLength)
    turned = stack_axis_angles(rotations)
    placed = np.asarray(translations, dtype=np.float64).reshape(len(turned), 3)
    order = np.arange(len(turned))
    if frames is not None:
        frames, order = np.unique(_numbers(frames, len(turned)), return_index=True)
    if not len(turned):
        raise ValueError("no poses")
    turned, placed = turned[order], placed[order]
    numbers = np.column_stack([turned.reshape(len(turned), -1), placed])
    valid = np.asarray(np.isfinite(numbers).all(axis=1))
    if lost is not None:
        valid &= ~np.asarray(lost, dtype=bool)[order]
    return Motion(
        root_rotations=turned[:, 0],
        root_translations=placed,
        joint_rotations=turned[:, 1:],
        valid=valid,
        betas=_median_betas(betas),
        body_model=body_model,
        frames=frames,
        times_s=None if times_s is None else times_s[order],
        intrinsic=None if is_assumed else _median_intrinsic(lens),
        assumed_focal=lens if is_assumed else None,
        anchor=anchor,
        space=space,
    )


def stack_rows(rows: list[Any]) -> Float[np.ndarray, "poses *rest"]:
    """One array of a list of arrays of one shape.

    Raises:
        ValueError: If their shapes differ.
    """
    return np.stack([np.asarray(row, dtype=np.float64) for row in rows])


def _numbers(frames: Any, count: int) -> Int[np.ndarray, "poses"]:
    numbers = np.asarray(frames, dtype=np.float64).reshape(-1)
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ValueError(f"{len(numbers)} frame numbers for {count} poses")
    return np.round(numbers).astype(np.int64)


def _median_betas(betas: Any) -> Float[np.ndarray, "betas"]:
    if betas is None:
        return np.zeros(0)
    rows = np.asarray(betas, dtype=np.float64)
    rows = rows.reshape(-1, rows.shape[-1]) if rows.ndim else rows.reshape(1, 1)
    rows = rows[np.isfinite(rows).all(axis=1)]
    return np.median(rows, axis=0) if len(rows) else np.zeros(0)


def _median_intrinsic(intrinsic: Any) -> Float[np.ndarray, "3 3"] | None:
    if intrinsic is None:
        return None
    matrix = np.asarray(intrinsic, dtype=np.float64)
    matrix = np.median(matrix.reshape(-1, 3, 3), axis=0)
    if not np.isfinite(matrix).all() or matrix[0, 0] <= 0.0:
        raise ValueError("a K that is no camera matrix")
    return matrix


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

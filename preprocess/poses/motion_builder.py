"""One person's poses, put together from what a tracker's file calls them."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from preprocess.body.body_pose import Motion, PoseSpace, RelativeFocalLength, RootAnchor
from preprocess.body.rotations import stack_axis_angles

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

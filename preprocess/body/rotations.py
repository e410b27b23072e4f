"""Rotations as trackers write them, brought to 24 axis-angles; and what lies between two."""

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from preprocess.body.kinematics import rotation_matrices

SHARED_JOINTS = 22
"""Root and body joints that SMPL, SMPL+H and SMPL-X have in common, in one order."""

SMPL_JOINTS = 24
"""Number of SMPL's joints, the root included."""

SUPPORTED_JOINT_COUNTS = (22, 24, 52, 55)
"""How many joints a pose may have: without hands, SMPL, SMPL+H, SMPL-X."""


def axis_angles_from_matrices(
    matrices: Float[np.ndarray, "*batch 3 3"],
) -> Float[np.ndarray, "*batch 3"]:
    """Axis-angles of the rotations nearest to 3x3 matrices; NaN for what is none."""
    flat = np.asarray(matrices, dtype=np.float64).reshape(-1, 3, 3)
    vectors = np.full((len(flat), 3), np.nan)
    good = np.asarray(np.isfinite(flat).all(axis=(1, 2)))
    good[good] = np.linalg.det(flat[good]) > 0.1
    if good.any():
        vectors[good] = Rotation.from_matrix(flat[good]).as_rotvec()
    return vectors.reshape(matrices.shape[:-1])


def stack_axis_angles(parts: list[Any]) -> Float[np.ndarray, "poses 24 3"]:
    """Join the parts of a pose's rotations, root first, into 24 axis-angles.

    Each part holds axis-angles (… or …x3) or matrices (…x3x3) with one row a pose. Of SMPL+H and
    SMPL-X (52 and 55 joints) the first 22 are taken: they are SMPL's; its two hands rest. So do
    joints that are missing at the end (a body pose of 63 numbers).

    Raises:
        ValueError: If it is another number of joints, or the rows do not match.
    """
    joints = np.concatenate(
        [_as_axis_angles(np.asarray(part, np.float64)) for part in parts], axis=1
    )
    if joints.shape[1] not in SUPPORTED_JOINT_COUNTS:
        raise ValueError(
            f"rotations of {joints.shape[1]} joints, root and hands included; expected one of "
            f"{', '.join(map(str, SUPPORTED_JOINT_COUNTS))}"
        )
    full = np.zeros((len(joints), SMPL_JOINTS, 3))
    kept = SMPL_JOINTS if joints.shape[1] == SMPL_JOINTS else SHARED_JOINTS
    full[:, :kept] = joints[:, :kept]
    return full


def _as_axis_angles(part: Float[np.ndarray, "..."]) -> Float[np.ndarray, "poses joints 3"]:
    if part.ndim >= 3 and part.shape[-2:] == (3, 3):
        return axis_angles_from_matrices(part.reshape(len(part), -1, 3, 3))
    if part.ndim < 2 or part[0].size % 3:
        raise ValueError(f"rotations of the shape {part.shape}")
    return part.reshape(len(part), -1, 3)


def slerp(
    before: Float[np.ndarray, "joints 3"],
    after: Float[np.ndarray, "joints 3"],
    fractions: Float[np.ndarray, "rows"],
) -> Float[np.ndarray, "rows joints 3"]:
    """Rotations on the shortest way from one to the other (slerp; Shoemake 1985)."""
    start = rotation_matrices(before)
    way = axis_angles_from_matrices(np.swapaxes(start, -1, -2) @ rotation_matrices(after))
    turned = start @ rotation_matrices(fractions[:, None, None] * way)
    return axis_angles_from_matrices(turned)

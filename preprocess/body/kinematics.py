"""SMPL's tree of 24 joints (Loper et al. 2015): its rotations and its forward kinematics."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from capture.camera import Matrix3, Transform, Vector3

JointPlaces = Float[np.ndarray, "24 3"]
"""A place, or a vector, for each of the 24 joints."""

Rotations = Float[np.ndarray, "*batch 3 3"]
"""Rotation matrices."""

Vectors = Float[np.ndarray, "*batch 3"]
"""Vectors, or axis-angles in radians."""

JOINT_NAMES = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2",
    "left_ankle", "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar",
    "right_collar", "head", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow",
    "left_wrist", "right_wrist", "left_hand", "right_hand",
)  # fmt: skip
"""Joints in the order of all arrays."""
HEAD_JOINT = JOINT_NAMES.index("head")
"""Joint at the base of the skull."""
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
"""Parent of each joint, before its children; -1 for the root."""


def rotation_matrices(axis_angles: Vectors) -> Rotations:
    """Rotation matrices of axis-angle vectors in radians (Rodrigues' formula)."""
    axis_angles = np.asarray(axis_angles, dtype=np.float64)
    angle = np.linalg.norm(axis_angles, axis=-1)[..., None, None]
    cross = cross_matrices(axis_angles)
    # sin(a)/a and (1 - cos(a))/a², both smooth at a = 0
    sine = np.sinc(angle / np.pi)
    cosine = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    return np.eye(3) + sine * cross + cosine * (cross @ cross)


def cross_matrices(vectors: Vectors) -> Rotations:
    """The matrices that multiply by the cross product."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1)
    return cross.reshape(*vectors.shape, 3)


def unit_vectors(vectors: Vectors) -> Vectors:
    """Vectors of length 1; 0 stays."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def shortest_turn(a: Vector3, b: Vector3) -> Matrix3:
    """The rotation by the least angle that takes direction a to direction b."""
    a, b = unit_vectors(a), unit_vectors(b)
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-8:
        axis = np.cross(a, np.eye(3)[np.abs(a).argmin()])
        return rotation_matrices(unit_vectors(axis) * (0.0 if a @ b > 0.0 else np.pi))
    return rotation_matrices(axis / sine * np.arctan2(sine, a @ b))


def rigid_transform(rotation: Rotations, translation: Vectors) -> Float[np.ndarray, "*batch 4 4"]:
    """Transforms x ↦ R x + t as 4x4 matrices."""
    transform = np.zeros((*translation.shape[:-1], 4, 4))
    transform[..., :3, :3], transform[..., :3, 3] = rotation, translation
    transform[..., 3, 3] = 1.0
    return transform


def joint_transforms(
    rest_joints: Float[np.ndarray, "joints 3"],
    parents: Int[np.ndarray, "joints"],
    rotations: Float[np.ndarray, "joints 3 3"],
) -> Float[np.ndarray, "joints 4 4"]:
    """Transforms of a point from the rest pose with each joint's frame (SMPL's matrices A), metres.

    Joints come after their parents; the root's is -1. Rotations are relative to the parent's, the
    root's about itself: G_j = G_p(j) [R_j | J_j - J_p(j)] and A_j x = G_j (x - J_j).
    """
    parents = np.asarray(parents)
    start = np.where(parents[:, None] >= 0, rest_joints[parents], 0.0)
    posed_from_joint = rigid_transform(rotations, rest_joints - start)
    for joint, parent in enumerate(parents.tolist()):
        if parent >= 0:
            posed_from_joint[joint] = posed_from_joint[parent] @ posed_from_joint[joint]
    turned = (posed_from_joint[:, :3, :3] @ rest_joints[:, :, None])[..., 0]
    posed_from_joint[:, :3, 3] -= turned
    return posed_from_joint


def body_from_rest(
    rest_joints: Float[np.ndarray, "joints 3"],
    parents: Int[np.ndarray, "joints"],
    joint_rotations: Float[np.ndarray, "others 3"],
) -> Float[np.ndarray, "joints 4 4"]:
    """Joint transforms with the root left at rest: the *body frame*, where articulation happens.

    Rest joints in metres; axis-angles of every joint but the root in radians.
    """
    rotations = rotation_matrices(np.concatenate([np.zeros((1, 3)), joint_rotations]))
    return joint_transforms(rest_joints, parents, rotations)


def descendant_matrix(parents: Int[np.ndarray, "joints"]) -> Float[np.ndarray, "joints joints"]:
    """1 where a joint (row) moves a bone (column): its own, and all below it."""
    below = np.eye(len(parents))
    for bone in range(len(parents)):
        joint = int(parents[bone])
        while joint >= 0:
            below[joint, bone] = 1.0
            joint = int(parents[joint])
    return below


def world_from_body(
    pelvis: Vector3, root_rotation: Vector3, root_translation: Vector3
) -> Transform:
    """The root's rigid motion: turn about the rest pelvis J0, then shift (SMPL's convention)."""
    rotation = rotation_matrices(root_rotation)
    return rigid_transform(rotation, pelvis + root_translation - rotation @ pelvis)


SUPPORTED_JOINT_COUNTS = (22, 24, 52, 55)
"""Numbers of joints that a pose may have: without hands, SMPL, SMPL+H, SMPL-X."""


def axis_angles_from_matrices(matrices: Rotations) -> Vectors:
    """Axis-angles of the rotations nearest to 3x3 matrices; NaN for what is none."""
    from scipy.spatial.transform import Rotation  # the player runs without scipy

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
    joints that are missing at the end (a body pose of 63 numbers). Other counts are a ValueError.
    """
    joints = np.concatenate(
        [_as_axis_angles(np.asarray(part, np.float64)) for part in parts], axis=1
    )
    if joints.shape[1] not in SUPPORTED_JOINT_COUNTS:
        raise ValueError(
            f"rotations of {joints.shape[1]} joints, root and hands included; expected one of "
            f"{', '.join(map(str, SUPPORTED_JOINT_COUNTS))}"
        )
    full = np.zeros((len(joints), 24, 3))
    kept = 24 if joints.shape[1] == 24 else 22  # that the bodies have in common, in one order
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
    share: float,
) -> Float[np.ndarray, "joints 3"]:
    """Rotations at a share of the shortest way from one to the other (slerp; Shoemake 1985)."""
    start = rotation_matrices(before)
    way = axis_angles_from_matrices(np.swapaxes(start, -1, -2) @ rotation_matrices(after))
    turned = start @ rotation_matrices(share * way)  # R_a exp(t log(R_aᵀ R_b))
    return axis_angles_from_matrices(turned)

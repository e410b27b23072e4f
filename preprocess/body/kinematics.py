"""SMPL's tree of 24 joints (Loper et al. 2015) and its forward kinematics, in numpy alone."""

import numpy as np
from jaxtyping import Float, Int

JOINT_NAMES = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2",
    "left_ankle", "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar",
    "right_collar", "head", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow",
    "left_wrist", "right_wrist", "left_hand", "right_hand",
)  # fmt: skip
"""Joints in the order of all arrays."""

PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
"""Parent of each joint, before its children; -1 for the root."""


def rotation_matrices(
    axis_angles: Float[np.ndarray, "*batch 3"],
) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotation matrices of axis-angle vectors in radians (Rodrigues' formula)."""
    axis_angles = np.asarray(axis_angles, dtype=np.float64)
    angle = np.linalg.norm(axis_angles, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(axis_angles, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1)
    cross = cross.reshape(*axis_angles.shape[:-1], 3, 3)
    # sin(a)/a and (1 - cos(a))/a², both smooth at a = 0
    sine = np.sinc(angle / np.pi)
    cosine = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    return np.eye(3) + sine * cross + cosine * (cross @ cross)


def rigid_transform(
    rotation: Float[np.ndarray, "*batch 3 3"], translation: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 4 4"]:
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
    """Where each joint's frame carries a point of the rest pose (SMPL's matrices A).

    Args:
        rest_joints: Joint positions in the rest pose, metres.
        parents: Parent of each joint, before its children; -1 for the root.
        rotations: Rotation of each joint relative to its parent; the root's about itself.
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

    Args:
        rest_joints: Joint positions in the rest pose, metres.
        parents: Parent of each joint; -1 for the root.
        joint_rotations: Axis-angle of every joint but the root, radians.
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
    pelvis: Float[np.ndarray, "3"],
    root_rotation: Float[np.ndarray, "3"],
    root_translation: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "4 4"]:
    """The rigid rest of a pose: turn about the rest pelvis J0, then shift (SMPL's convention)."""
    rotation = rotation_matrices(root_rotation)
    return rigid_transform(rotation, pelvis + root_translation - rotation @ pelvis)

"""Poses brought to the body and the cameras that are really used.

A tracker's poses are about its own body (where the pelvis rests), its own focal length, its own
camera's or world's axes. Rotations stay; what changes is where the root is.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from capture.camera import Camera
from preprocess.body.body_pose import Motion
from preprocess.body.kinematics import axis_angles_from_matrices, rotation_matrices
from preprocess.body.parametric_body import ShapedBody
from preprocess.cameras.camera_file import CameraTrack, tracker_intrinsic_matrix
from preprocess.cameras.named_camera import invert_rigid

SMPLX_PELVIS = np.array([0.0031, -0.3514, 0.0120])
"""Where SMPL-X's neutral mean shape has its pelvis at rest, metres (its joint regressor's)."""

FOCAL_TOLERANCE = 0.01
"""Focal lengths and principal points nearer than this share are one."""


def place_in_camera_world(
    motion: Motion, shaped: ShapedBody, cameras: CameraTrack, *, cameras_given: bool
) -> Motion:
    """The motion as SMPL's: about the body's pelvis, in the world of the cameras.

    Args:
        motion: As it was read.
        shaped: The person's body.
        cameras: Of the frames' size.
        cameras_given: Whether the user gave them; if not, a file's own cameras count.
    """
    motion = anchor_at_pelvis(motion, shaped.joints)
    if motion.space == "camera":
        motion = _refocus_motion(motion, shaped, cameras[0])
        if cameras.is_moving or not np.allclose(cameras[0].camera_from_world, np.eye(4)):
            worlds = [invert_rigid(_camera_of(motion, row, cameras)) for row in range(len(motion))]
            motion = transform_motion(motion, np.stack(worlds), shaped.joints[0])
        return replace(motion, space="world")
    if motion.camera_from_world is not None and not cameras_given:
        moved_in = transform_motion(motion, motion.camera_from_world, shaped.joints[0])
        return replace(moved_in, camera_from_world=None)
    return motion


def anchor_at_pelvis(motion: Motion, joints: Float[np.ndarray, "24 3"]) -> Motion:
    """The same poses with `root_translations` as SMPL has them, for a body's rest joints.

    world = R (x - a) + t is R (x - J0) + J0 + t' with t' = t + R (J0 - a) - J0.
    """
    pelvis = joints[0]
    if motion.anchor == "pelvis":
        if motion.body_model != "smplx":
            return motion
        shifted = motion.root_translations + (SMPLX_PELVIS - pelvis)
        return replace(motion, root_translations=shifted)
    anchor = np.zeros(3) if motion.anchor == "origin" else joints[1:3].mean(axis=0)
    turned = rotation_matrices(motion.root_rotations) @ (pelvis - anchor)
    return replace(
        motion,
        anchor="pelvis",
        root_translations=motion.root_translations + turned - pelvis,
    )


def transform_motion(
    motion: Motion, a_from_b: Float[np.ndarray, "poses 4 4"], pelvis: Float[np.ndarray, "3"]
) -> Motion:
    """The same poses in another world, x' = A x + b a row: t' = A (J0 + t) + b - J0."""
    turn, shift = a_from_b[:, :3, :3], a_from_b[:, :3, 3]
    at = np.einsum("nab,nb->na", turn, pelvis + motion.root_translations) + shift
    return replace(
        motion,
        root_rotations=axis_angles_from_matrices(turn @ rotation_matrices(motion.root_rotations)),
        root_translations=at - pelvis,
    )


def refocus_translation(
    joints: Float[np.ndarray, "24 3"],
    intrinsic: Float[np.ndarray, "3 3"],
    camera: Camera,
) -> Float[np.ndarray, "3"]:
    """How far a body must be moved so that another camera sees it where the tracker's saw it.

    Args:
        joints: In the tracker's camera, metres.
        intrinsic: The tracker's K, for pictures of the camera's size.
        camera: The true one; its place does not matter.
    """
    pixels = joints[:, :2] / joints[:, 2:] * intrinsic[[0, 1], [0, 1]] + intrinsic[:2, 2]
    return place_by_pixels(joints, pixels, camera)


def place_by_pixels(
    joints: Float[np.ndarray, "joints 3"],
    pixels: Float[np.ndarray, "joints 2"],
    camera: Camera,
) -> Float[np.ndarray, "3"]:
    """How far a body must be moved so that a camera sees its joints at given pixels.

    Linear least squares over the joints, rows f t_x - (u - c) t_z = (u - c) z - f x.

    Args:
        joints: In the camera's axes, metres, from any place.
        pixels: Where each is to be seen.
        camera: Without distortion; its place does not matter.
    """
    middle = joints.mean(axis=0)
    shape = joints - middle
    focal, away = np.array(camera.focal_px), pixels - np.array(camera.center_px)
    rows = np.zeros((len(joints), 2, 3))
    rows[:, 0, 0], rows[:, 1, 1] = focal
    rows[:, :, 2] = -away
    right = away * shape[:, 2:] - focal * shape[:, :2]
    solved, *_ = np.linalg.lstsq(rows.reshape(-1, 3), right.reshape(-1), rcond=None)
    return solved - middle


def _refocus_motion(motion: Motion, shaped: ShapedBody, camera: Camera) -> Motion:
    """The motion as the true camera sees it, if the tracker took another focal length."""
    intrinsic = tracker_intrinsic_matrix(motion, camera.size_px)
    if intrinsic is None or _same_intrinsics(intrinsic, camera):
        return motion
    shifted = motion.root_translations.copy()
    for row in np.flatnonzero(motion.valid):
        joints = shaped.with_pose(motion[int(row)]).joints()
        if (joints[:, 2] > 0.0).all():
            shifted[row] += refocus_translation(joints, intrinsic, camera)
    return replace(motion, root_translations=shifted)


def _same_intrinsics(intrinsic: Float[np.ndarray, "3 3"], camera: Camera) -> bool:
    off = np.abs(intrinsic - camera.intrinsic)[:2]
    return bool((off <= FOCAL_TOLERANCE * max(camera.focal_px)).all())


def _camera_of(motion: Motion, row: int, cameras: CameraTrack) -> Float[np.ndarray, "4 4"]:
    frame = row if motion.frames is None else int(motion.frames[row])
    return cameras[min(frame, len(cameras.cameras) - 1)].camera_from_world

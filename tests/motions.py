"""Motions of a few lines for tests: what they leave out is at rest, valid, and of no shape."""

from typing import Any

import numpy as np

from capture.camera import Camera
from preprocess.body.body_pose import Motion
from preprocess.body.kinematics import PARENTS
from preprocess.body.parametric_body import ShapedBody
from preprocess.body.proportion_space import ProportionSpace
from preprocess.fitting.clip_poses import ClipPoses
from preprocess.fitting.joint_fitting import LANDMARKS
from preprocess.fitting.keypoint_rows import KEYPOINT_JOINTS, KEYPOINT_OFFSETS_M, KeypointModel
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


def posed_joints(motion: Motion, shaped: ShapedBody) -> np.ndarray:
    """Posed joints of every row of a motion, metres."""
    return np.stack([shaped.with_pose(motion[row]).joints() for row in range(len(motion))])


def perfect_track(motion: Motion, shaped: ShapedBody, camera: Camera) -> KeypointTrack:
    """The key points that a perfect tracker would find of a motion, at 30 frames a second."""
    points, offsets_m = [], KeypointModel(ProportionSpace.around(shaped)).offsets_m
    rest = shaped.joints[KEYPOINT_JOINTS] + offsets_m
    for row in range(len(motion)):
        carried = shaped.with_pose(motion[row]).world_from_rest()[KEYPOINT_JOINTS]
        points.append(np.einsum("pab,pb->pa", carried[:, :3, :3], rest) + carried[:, :3, 3])
    world = np.stack(points)
    pixels = camera.project(world.reshape(-1, 3)).reshape(-1, 33, 2)
    seen = world @ camera.camera_from_world[:3, :3].T
    seen -= seen[:, [23, 24]].mean(axis=1, keepdims=True)
    numbers = np.arange(len(motion))
    parts = {"image_px": pixels, "world_m": seen, "times_s": numbers / 30.0}
    return make_track(numbers, camera.size_px, **parts)


def posed_points(poses: ClipPoses, rest_joints: np.ndarray) -> np.ndarray:
    """Places of `POINT_NAMES` in each pose, metres: joints, then landmarks."""
    joints, numbers = poses.joints(rest_joints, np.array(PARENTS)), list(LANDMARKS.values())
    on = np.array(KEYPOINT_JOINTS)[numbers]
    offsets = (joints.turns[:, on] @ KEYPOINT_OFFSETS_M[numbers][:, :, None])[..., 0]
    return np.concatenate([joints.places, joints.places[:, on] + offsets], axis=1)


def angles_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between rotation matrices, degrees."""
    cosine = (np.trace(a.swapaxes(-1, -2) @ b, axis1=-2, axis2=-1) - 1.0) / 2.0
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))

"""Scores of a run against the truth of a phone-like capture: poses, proportions, novel poses."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from avatar.evaluation.held_out import HeldOutFrame, score_frame
from avatar.training import checkpoint
from avatar.training.checkpoint import LAST_RUN_FILE, load_frames
from avatar.training.held_out_pose_fitting import fit_test_poses
from avatar.training.pose_optimizer import PoseOptimizer
from avatar.training.trainer import Trainer
from baselines.systems.compared_capture import novel_observations
from capture.camera import Camera
from preprocess.body.body_pose import BodyPose
from preprocess.body.kinematics import axis_angles_from_matrices, rotation_matrices
from preprocess.body.parametric_body import ShapedBody, load_body_model, read_shaped_body
from preprocess.cameras.camera_file import read_cameras
from preprocess.poses.pose_format_registry import read_poses

TRACKED_JOINTS = 22
"""Joints that are compared, the root included: without the hands' inner joints."""


class NovelPoseFit(NamedTuple):
    """Mean PSNR of the volume renderer in poses never filmed, dB, on white.

    Attributes:
        placed: At the true joint rotations, the root placed so that the joints appear where the
            truth's do: nothing is fitted to the pictures.
        fitted: After the product's own fitting of held-out poses, which started from these.
        fitted_mask: The same where the person is.
        fitted_ssim: SSIM of the same.
    """

    placed: float
    fitted: float
    fitted_mask: float
    fitted_ssim: float


def joint_error_cm(run: Path, capture: Path) -> float:
    """Mean distance of the rest joints that were learnt on to the truth's, pelvis on pelvis, cm."""
    learnt = read_shaped_body(run / "checkpoint" / "person.npz", load_body_model()).joints
    return rest_joint_distance_cm(learnt, _true_body(capture).joints)


def rest_joint_distance_cm(
    one: Float[np.ndarray, "24 3"], other: Float[np.ndarray, "24 3"]
) -> float:
    """Mean distance of rest joints but the pelvis, which is laid on the other's, cm."""
    away = ((one - one[0]) - (other - other[0]))[1:TRACKED_JOINTS]
    return float(100.0 * np.linalg.norm(away, axis=1).mean())


def given_pose_error_deg(capture: Path) -> float:
    """Mean error of the poses that the user has, degrees, over joints and frames."""
    given, truth = (read_poses(folder / "poses.npz") for folder in (capture, capture / "truth"))
    cameras = [_camera(folder / "cameras.npz") for folder in (capture, capture / "truth")]
    return float(
        np.mean([
            pose_error_deg((given[row], cameras[0]), (truth[row], cameras[1]))
            for row in range(len(truth))
        ])
    )  # fmt: skip


def learnt_pose_error_deg(run: Path, capture: Path) -> float:
    """Mean error of the corrected poses of the frames that were trained on, degrees."""
    trainer, _ = checkpoint.load(run / "checkpoint")
    truth = read_poses(capture / "truth" / "poses.npz")
    true_camera = _camera(capture / "truth" / "cameras.npz")
    errors = []
    for frame in load_frames(run / "checkpoint" / LAST_RUN_FILE):
        pose = corrected_pose(trainer, frame.index, frame.pose)
        errors.append(pose_error_deg((pose, frame.view.camera), (truth[frame.index], true_camera)))
    return float(np.mean(errors))


def corrected_pose(trainer: Trainer, index: int, given: BodyPose) -> BodyPose:
    """The pose of a frame after the corrections of training."""
    poses = PoseOptimizer(trainer.avatar.rig, 1)
    poses.set_pose(0, given, correction=trainer.pose_corrections.get(index))
    return poses.pose(0)


def pose_error_deg(one: tuple[BodyPose, Camera], other: tuple[BodyPose, Camera]) -> float:
    """Mean angle between two poses, degrees: the root's in the camera, joints' to their parents."""
    a, b = _camera_rotations(*one), _camera_rotations(*other)
    vectors = axis_angles_from_matrices(np.swapaxes(a, -1, -2) @ b)
    return float(np.rad2deg(np.linalg.norm(vectors, axis=-1)).mean())


def score_novel_poses(run: Path, capture: Path) -> NovelPoseFit:
    """How well the avatar shows the true pictures of poses that were never filmed."""
    trainer, _ = checkpoint.load(run / "checkpoint")
    person = read_shaped_body(run / "checkpoint" / "person.npz", load_body_model())
    placed = [HeldOutFrame(observation=seen) for seen in novel_observations(capture, person)]
    before = [score_frame(trainer.avatar, frame) for frame in placed]
    fitted = [score_frame(trainer.avatar, frame) for frame in fit_test_poses(trainer, placed)]
    return NovelPoseFit(
        placed=float(np.mean([score.psnr for score in before])),
        fitted=float(np.mean([score.psnr for score in fitted])),
        fitted_mask=float(np.mean([score.psnr_mask for score in fitted])),
        fitted_ssim=float(np.mean([score.ssim for score in fitted])),
    )


def _true_body(capture: Path) -> ShapedBody:
    return load_body_model(capture / "truth" / "body.npz").with_shape()


def _camera(path: Path) -> Camera:
    with np.load(path) as arrays:
        size_px = int(arrays["width"]), int(arrays["height"])
    return read_cameras(path, size_px)[0]


def _camera_rotations(pose: BodyPose, camera: Camera) -> Float[np.ndarray, "22 3 3"]:
    """Rotations of the root in the camera, and of the joints relative to their parents."""
    vectors = np.concatenate([pose.root_rotation[None], pose.joint_rotations])[:TRACKED_JOINTS]
    rotations = rotation_matrices(vectors)
    rotations[0] = camera.camera_from_world[:3, :3] @ rotations[0]
    return rotations

"""Captures as a phone gives them: what is wrong with them, and the truth beside it."""

import cv2
import numpy as np
import pytest

from instant_avatar import sample
from instant_avatar.studio.shoot import ShootConfig, film_capture
from preprocess.body.kinematics import axis_angles_from_matrices, rotation_matrices
from preprocess.body.parametric_body import load_body_model
from preprocess.cameras.camera_file import read_cameras
from preprocess.capture_inputs import CaptureInputs
from preprocess.observation import Observation
from preprocess.open_capture import open_capture
from preprocess.poses.pose_format_registry import read_poses

FRAMES = 24
PHONE = ShootConfig(frames=FRAMES, size=72, subject=3, like_a_phone=True)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("phone") / "capture"
    film_capture(folder, PHONE)
    return folder


def mean_joint_error_deg(one, other):
    """Mean angle between the local rotations of joints 1 … 21 of two poses, degrees."""
    a = rotation_matrices(one.joint_rotations[:21])
    b = rotation_matrices(other.joint_rotations[:21])
    vectors = axis_angles_from_matrices(np.swapaxes(a, -1, -2) @ b)
    return float(np.rad2deg(np.linalg.norm(vectors, axis=-1)).mean())


def test_the_command_names_no_preview(call, tmp_path):
    ended = call(sample, tmp_path / "c", "--like-a-phone", "--frames", 2, "--size", 36)
    assert ended.code == 0, ended.err
    assert "preview" not in ended.err
    assert "--poses" in ended.err
    assert (tmp_path / "c" / "truth" / "body.npz").exists()


@pytest.mark.slow
def test_poses_are_off_by_some_degrees_the_focal_length_by_a_tenth_and_masks_a_little(capture):
    given, truth = (read_poses(folder / "poses.npz") for folder in (capture, capture / "truth"))
    errors = [mean_joint_error_deg(given[i], truth[i]) for i in range(FRAMES)]
    assert 2.5 < np.median(errors) < 7.0
    focal = [
        read_cameras(folder / "cameras.npz", (72, 128))[0].focal_px[0]
        for folder in (capture, capture / "truth")
    ]
    assert 0.07 < abs(focal[0] / focal[1] - 1.0) < 0.13
    assert not np.any(given.betas)
    given, exact = (
        np.stack([cv2.imread(str(path), 0) for path in sorted((folder / "masks").glob("*.png"))])
        for folder in (capture, capture / "truth")
    )
    assert ((exact > 250) & (given < 5)).sum(axis=(1, 2)).max() > 5  # a hand, or a hole
    assert 0.85 < np.minimum(given, exact).sum() / np.maximum(given, exact).sum() < 0.99


@pytest.mark.slow
def test_the_exact_twin_can_be_opened_and_so_can_the_novel_poses(capture):
    truth = capture / "truth"
    twin = CaptureInputs(
        video=capture / "video.mp4", poses=truth / "poses.npz", masks=truth / "masks",
        cameras=str(truth / "cameras.npz"), body=truth / "body.npz",
    )  # fmt: skip
    session = open_capture(twin)
    np.testing.assert_allclose(
        session.shaped.joints, load_body_model(truth / "body.npz").joints, atol=1e-9
    )
    novel = open_capture(CaptureInputs(video=truth / "novel", body=truth / "body.npz"))
    assert len([s for s in novel.observations() if isinstance(s, Observation)]) == 12

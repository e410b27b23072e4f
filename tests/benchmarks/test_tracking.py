"""What the benchmark of tracked people compares with the truth."""

import shutil
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.tracking import (
    bare_film,
)
from benchmarks.tracking_scores import (
    score_joints,
)
from capture.camera import Camera
from capture.image_folder import write_png
from preprocess.body.body_pose import Motion
from preprocess.body.body_surface import MeshSilhouette
from preprocess.cameras.camera_file import CameraTrack, write_cameras
from preprocess.poses.pose_file import write_motion

FRAMES = 4
CAMERA = Camera(
    focal_px=(60.0, 60.0), center_px=(24.0, 40.0), size_px=(48, 80), camera_from_world=np.eye(4)
)


def turning_person() -> Motion:
    yaw = np.deg2rad(40.0) * np.arange(FRAMES)[:, None] * np.array([0.0, 1.0, 0.0])
    roots = Rotation.from_rotvec([np.pi, 0.0, 0.0]) * Rotation.from_rotvec(yaw)
    return Motion(
        root_rotations=roots.as_rotvec(),
        root_translations=np.tile([0.0, 0.2, 3.0], (FRAMES, 1)),
        joint_rotations=np.zeros((FRAMES, 23, 3)),
        valid=np.ones(FRAMES, dtype=bool),
        betas=np.zeros(10),
        body_model="body24",
        frames=np.arange(FRAMES),
        intrinsic=CAMERA.intrinsic,
    )


@pytest.fixture
def capture(tmp_path, shaped) -> Path:
    """Pictures, masks and poses of a person before a camera at the origin, and their truth."""
    folder, motion = tmp_path / "capture", turning_person()
    for name in ("images", "masks", "truth/masks"):
        (folder / name).mkdir(parents=True)
    body = MeshSilhouette(shaped)
    for row in range(FRAMES):
        mask = body.draw_pose(motion[row], CAMERA).astype(np.uint8) * 255
        write_png(folder / "images" / f"{row:04d}.png", np.zeros((80, 48, 3), dtype=np.uint8))
        write_png(folder / "masks" / f"{row:04d}.png", mask)
        write_png(folder / "truth" / "masks" / f"{row:04d}.png", mask)
    write_motion(folder / "poses.npz", motion)
    write_motion(folder / "truth" / "poses.npz", motion)
    write_cameras(folder / "truth" / "cameras.npz", CameraTrack(cameras=(CAMERA,), source=""))
    shutil.copy(str(files("preprocess") / "data" / "body24.npz"), folder / "truth" / "body.npz")
    return folder


def test_poses_like_the_truth_have_no_error(capture, tmp_path):
    score = score_joints(capture, bare_film(capture, tmp_path / "bare"), capture / "truth")
    assert score.error_mm == pytest.approx(0.0, abs=1e-6)
    assert score.swapped_percent == 0.0
    assert score.missing_percent == 0.0


def test_a_person_seen_from_behind_is_exchanged_and_a_lost_frame_is_missing(capture, tmp_path):
    motion = turning_person()
    roots = Rotation.from_rotvec(motion.root_rotations)
    roots = Rotation.concatenate([roots[:3], roots[3] * Rotation.from_rotvec([0.0, np.pi, 0.0])])
    valid = np.array([False, True, True, True])
    write_motion(
        capture / "poses.npz", replace(motion, root_rotations=roots.as_rotvec(), valid=valid)
    )
    score = score_joints(capture, bare_film(capture, tmp_path / "bare"), capture / "truth")
    assert score.missing_percent == pytest.approx(25.0)
    assert score.swapped_percent == pytest.approx(100.0 / 3.0)
    assert score.error_mm > 50.0

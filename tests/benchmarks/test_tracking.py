"""What the benchmark of tracked people compares with the truth."""

import shutil
import threading
import time
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from avatar.events import Stepped, WaitingForFrame
from benchmarks.first_tracked_step import FirstStep
from benchmarks.tracking import (
    OTHER_PACKAGES,
    TrackingJob,
    bare_film,
    measure_installation,
    run_time_packages,
)
from benchmarks.tracking_cost import CpuTimed
from benchmarks.tracking_scores import (
    are_sides_swapped,
    body_iou,
    joint_distance_mm,
    mask_iou,
    open_tracked,
    score_joints,
)
from capture.camera import Camera
from capture.image_folder import write_png
from capture.source_opening import open_source
from capture.video import lossless_video
from preprocess.body.body_pose import Motion
from preprocess.body.body_surface import MeshSilhouette
from preprocess.cameras.camera_file import CameraTrack, write_cameras
from preprocess.capture_paths import find_own_masks, find_own_poses
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


def test_joints_are_compared_pelvis_on_pelvis_in_one_scale(shaped, rng):
    joints = np.stack([shaped.joints, shaped.joints])
    moved = 1.3 * joints + rng.standard_normal((2, 1, 3))
    assert joint_distance_mm(moved, joints) == pytest.approx(0.0, abs=1e-6)
    grown = joints * np.array([1.0, 1.2])[:, None, None]  # each frame in a scale of its own
    assert joint_distance_mm(grown, joints) > 20.0


def test_shoulders_alone_may_be_exchanged(shaped):
    joints = np.stack([shaped.joints] * 2)
    wrong = joints.copy()
    wrong[1, [16, 17]] = joints[1, [17, 16]]
    assert are_sides_swapped(wrong, joints).tolist() == [False, True]


def test_masks_and_body_are_compared_with_given_masks(capture, tmp_path):
    film = bare_film(capture, tmp_path / "bare")
    assert mask_iou(capture / "masks", capture / "truth" / "masks", CAMERA.size_px) > 0.97
    assert body_iou(open_tracked(capture, film, capture / "truth" / "masks")) > 0.99
    motion = turning_person()
    aside = motion.root_translations + np.array([0.3, 0.0, 0.0])
    write_motion(capture / "poses.npz", replace(motion, root_translations=aside))
    assert body_iou(open_tracked(capture, film, capture / "truth" / "masks")) < 0.6


@pytest.mark.parametrize("kind", ["images", "video.mp4"])
def test_nothing_lies_beside_a_bare_film(capture, tmp_path, kind):
    if kind == "video.mp4":
        shutil.rmtree(capture / "images")
        with lossless_video(capture / kind, CAMERA.size_px, 30.0, FRAMES) as writer:
            for _ in range(FRAMES):
                writer.write(np.zeros((80, 48, 3), dtype=np.uint8))
    for _ in range(2):  # the link of an earlier run is used again
        film = bare_film(capture, tmp_path / "bare")
        assert open_source(film).frame_count == FRAMES
        assert find_own_masks(film) is None
        assert find_own_poses(film) is None


def test_a_bare_film_of_the_same_name_replaces_another(capture, tmp_path):
    other = shutil.copytree(capture, tmp_path / "elsewhere" / capture.name)
    (other / "images" / "0000.png").unlink()
    assert open_source(bare_film(capture, tmp_path / "bare")).frame_count == FRAMES
    assert open_source(bare_film(other, tmp_path / "bare")).frame_count == FRAMES - 1


def test_tracking_needs_no_new_package_and_fits_into_the_installation():
    assert run_time_packages() == OTHER_PACKAGES
    networks, packages = measure_installation()
    assert networks.value is not None
    assert 1.0 < networks.value < 25.0
    assert packages.value == 0.0


def test_quick_is_small_but_keeps_the_steps_that_were_asked_for():
    assert TrackingJob(quick=True).effective.learning.steps == 600
    job = TrackingJob(quick=True, steps=7).effective
    assert (job.learning.size, job.learning.steps) == (270, 7)
    assert TrackingJob().effective.learning.seconds == 120.0


def test_cpu_time_of_calls_is_summed_and_waiting_is_not():
    busy = CpuTimed(lambda rounds: sum(range(rounds)))
    assert busy(1000) == 499_500
    once = busy.cpu_s
    busy(300_000)
    assert busy.cpu_s > once
    waits = CpuTimed(time.sleep)
    waits(0.2)
    assert waits.cpu_s < 0.1


def test_a_session_ends_with_its_first_step():
    stop = threading.Event()
    first = FirstStep(stop)
    first.on_event(WaitingForFrame())
    assert not stop.is_set()
    stepped = Stepped(step=1, wall_seconds=0.1, loss=1.0, samples_per_ray=1.0, frames_seen=1)
    first.on_event(stepped)
    at = first.at
    assert stop.is_set()
    first.on_event(stepped)
    assert first.at == at

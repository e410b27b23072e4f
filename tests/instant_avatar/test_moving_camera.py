"""A camera that moves: the film told in another world for each frame, seen as it was."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from instant_avatar import check
from instant_avatar.capture_validation import passes_quick_check
from preprocess.capture_inputs import CaptureInputs
from preprocess.observation import Observation
from preprocess.open_capture import open_capture
from preprocess.poses.motion_builder import transform_motion
from preprocess.poses.pose_file import write_motion
from preprocess.poses.pose_format_registry import read_poses


@pytest.fixture
def walk(capture):
    """The film of a camera that walks, with a transforms.json; the last two frames have none.

    Body and camera are moved together, each frame otherwise: pictures stay as they are.
    """
    still = open_capture(CaptureInputs(video=capture))
    frames, camera = len(still.motion), still.cameras[0]
    worlds = np.broadcast_to(np.eye(4), (frames, 4, 4)).copy()
    angles = np.linspace(0.0, 1.5, frames)
    worlds[:, :3, :3] = Rotation.from_rotvec(np.outer(angles, [0.0, 1.0, 0.0])).as_matrix()
    worlds[:, :3, 3] = np.column_stack([angles, 0.2 * angles, -angles])
    (capture / "poses.npz").unlink()
    write_motion(
        capture / "poses.npz", transform_motion(still.motion, worlds, still.shaped.joints[0])
    )
    (capture / "cameras.npz").unlink()
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    poses = [world @ np.linalg.inv(camera.camera_from_world) @ flip for world in worlds]
    content = {
        "w": camera.size_px[0], "h": camera.size_px[1],
        "fl_x": camera.focal_px[0], "fl_y": camera.focal_px[1],
        "cx": camera.center_px[0], "cy": camera.center_px[1],
        "frames": [
            {"file_path": f"frame_{number:04d}.png", "transform_matrix": pose.tolist()}
            for number, pose in enumerate(poses[:-2])
        ],
    }  # fmt: skip
    (capture / "transforms.json").write_text(json.dumps(content))
    return capture, still


def test_each_frame_is_seen_by_its_own_camera(walk):
    folder, still = walk
    moving = open_capture(CaptureInputs(video=folder))
    assert moving.cameras.is_moving
    assert moving.pixel_footprint_m() == pytest.approx(still.pixel_footprint_m(), rel=1e-6)
    assert passes_quick_check(moving)
    for then, now in zip(still.observations(), moving.observations(), strict=True):
        if not isinstance(now, Observation):
            assert (now.index >= 22, now.reason) == (True, "no camera")
            continue
        assert isinstance(then, Observation)
        joints = [
            one.camera.project(which.shaped.with_pose(one.pose).joints())
            for one, which in ((then, still), (now, moving))
        ]
        np.testing.assert_allclose(joints[0], joints[1], atol=1e-6)


@pytest.mark.slow
def test_an_avatar_is_learnt_and_scored_through_a_moving_camera(
    walk, call_ingest, without_baking, tmp_path
):
    folder, _ = walk
    outcome = call_ingest(folder, "--out", tmp_path / "run", steps=100)
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert [drop["index"] for drop in report["frames"]["dropped"]] == [22, 23]
    assert report["held_out"]["psnr"] > 14.0
    assert outcome.code == 0


@pytest.mark.slow
def test_a_moving_camera_is_checked_and_mended(walk, tmp_path):
    folder, _ = walk
    motion = read_poses(folder / "poses.npz")
    (folder / "poses.npz").unlink()
    write_motion(folder / "poses.npz", replace(motion, frames=np.arange(24) + 3, times_s=None))
    out, found = tmp_path / "mended", tmp_path / "found.json"
    sheet = tmp_path / "sheet.png"
    words = [folder, "--fix", out, "--json", found, "--sheet", sheet]
    assert check.main([str(word) for word in words]) == 0
    assert json.loads(found.read_text())["cause"] == "frame_offset"


def test_a_player_looks_through_the_films_camera_and_those_of_other_programs(
    package, film, walk, call_play, tmp_path
):
    folder, _ = walk
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"] = content["frames"][:8]
    (folder / "transforms.json").write_text(json.dumps(content))
    for name, place, cameras in (("a", folder, "transforms.json"), ("b", film, "cameras.npz")):
        poses, out = tmp_path / f"{name}.npz", tmp_path / name
        write_motion(poses, read_poses(place / "poses.npz").select_rows(np.arange(8)))
        ended = call_play(package, "--poses", poses, "--camera", place / cameras, "--out", out)
        assert ended.code == 0, ended.err
    for number in (0, 3, 7):
        a, b = (cv2.imread(str(tmp_path / f / f"{number:04d}.png"), -1) for f in "ab")
        mask = cv2.imread(str(film / "masks" / f"{number:04d}.png"), cv2.IMREAD_GRAYSCALE) > 127
        assert a is not None
        assert b is not None
        assert np.abs(a.astype(int) - b.astype(int)).mean() < 0.5
        drawn = b[..., 3] > 127
        assert (drawn & mask).sum() / (drawn | mask).sum() > 0.85

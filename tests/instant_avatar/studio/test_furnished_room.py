"""The room and the phone that is carried around in it."""

import numpy as np
import pytest

from capture.atomic_files import LIST_NAME as LIST
from instant_avatar.studio import staging
from instant_avatar.studio.actor import Actor
from instant_avatar.studio.furnished_room import FurnishedRoom
from instant_avatar.studio.lighting import rasterize
from instant_avatar.studio.shoot import ShootConfig, film_capture
from preprocess.cameras.camera_file import read_cameras
from preprocess.poses.pose_format_registry import read_poses

WALK = ShootConfig(frames=6, size=128, motion="walkaround")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shoot") / "walk"
    film_capture(folder, WALK)
    return folder


def test_the_phone_walks_an_arc_and_holds_the_person_in_the_picture():
    actor = Actor.of(2)
    motion = staging.gesturing_motion(actor, frames=40, fps=30.0, turns=-0.75, seed=2)
    at = (motion.root_translations + actor.shaped.joints[0])[:, [0, 2]]
    cameras = staging.handheld_cameras(at, staging.actor_height_m(actor), 960, 2)
    eyes = np.stack([camera.center_world for camera in cameras])
    angles = np.rad2deg(np.arctan2(eyes[:, 0], eyes[:, 2]))
    assert np.ptp(angles) > 100.0
    away = np.linalg.norm(eyes[:, [0, 2]], axis=1)
    assert 2.4 < away.min() < away.max() < 3.2
    second = np.diff(eyes, 2, axis=0)
    assert 0.002 < np.sqrt((second**2).mean()) < 0.03  # a hand that trembles
    for row in range(0, 40, 3):
        camera = cameras[row]
        assert camera.size_px == (960, 540)
        pixels = camera.project(actor.vertices(motion[row]))
        assert pixels.min() > 5.0
        assert (pixels < [955.0, 535.0]).all()
        assert np.ptp(pixels[:, 1]) > 0.65 * 540
        assert abs(actor.sole_height_m(motion[row])) < 1e-9


def test_the_cameras_are_written_to_the_ground_truth_only(capture):
    assert {path.name for path in capture.iterdir()} == {
        "video.mp4", "preview.mp4", "masks", "poses.npz", "dance.npz", "truth", LIST
    }  # fmt: skip
    with np.load(capture / "poses.npz") as poses:
        assert "camera" not in poses
        assert str(poses["space"]) == "camera"
    track = read_cameras(capture / "truth" / "cameras.npz", (128, 72))
    assert len(track.cameras) == WALK.frames
    given, truth = (read_poses(capture / name) for name in ("poses.npz", "truth/poses.npz"))
    np.testing.assert_allclose(given.intrinsic, track[0].intrinsic)
    shaped = Actor.of(1).shaped
    for row, camera in enumerate(track.cameras):
        inside = shaped.with_pose(given[row]).joints()
        world = shaped.with_pose(truth[row]).joints()
        view = camera.camera_from_world
        np.testing.assert_allclose(inside, world @ view[:3, :3].T + view[:3, 3], atol=1e-9)


def test_the_room_is_closed_and_the_floor_is_darker_about_the_feet():
    room, camera = FurnishedRoom.furnished("room", 96, 0), staging.standing_camera(1.7, 96)
    feet = np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]])
    seen = rasterize(room.points, room.triangles, camera, supersampling=1)
    assert (seen.face >= 0).all()
    with_feet, without = (room.render(camera, each, 0).astype(int) for each in (feet, feet[:0]))
    column, row = camera.project(np.zeros(3)).round().astype(int)
    assert (without - with_feet)[row, column].mean() > 20.0
    assert np.array_equal(without[:10], with_feet[:10])

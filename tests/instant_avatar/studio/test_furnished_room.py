"""The room and the phone that is carried around in it."""

import numpy as np
import pytest

from capture.atomic_files import LIST_NAME as LIST
from capture.input_error import InputError
from instant_avatar.studio import staging
from instant_avatar.studio.actor import Actor
from instant_avatar.studio.furnished_room import FurnishedRoom
from instant_avatar.studio.shoot import ShootConfig, film_capture
from preprocess.cameras.camera_file import read_cameras
from preprocess.capture_session import CaptureInputs
from preprocess.observation import Observation
from preprocess.open_capture import open_capture
from preprocess.poses.pose_file import read_motion

WALK = ShootConfig(frames=6, size=128, motion="walkaround")


@pytest.fixture(scope="module")
def room():
    return FurnishedRoom.furnished("room", 192, 0)


@pytest.fixture(scope="module")
def cameras():
    return staging.handheld_cameras(np.zeros((9, 2)), 1.8, 192, 3)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shoot") / "walk"
    film_capture(folder, WALK)
    return folder


def points_seen(camera, depth):
    """The world's point in the middle of each pixel, from its depth."""
    rays = camera.ray_directions(camera.pixel_centers())
    along = rays @ camera.camera_from_world[2, :3]
    return camera.center_world + rays * (depth / along)[..., None]


def in_box(solids, solid, points):
    """Points of the world in the frame of a box, which the test turns by itself."""
    cosine, sine = solids.yaw_cos_sin[solid]
    turn = np.array([[cosine, -sine], [sine, cosine]])
    own = points.copy()
    middle = solids.centers_xz[solid]
    own[..., [0, 2]] = (points[..., [0, 2]] - middle) @ turn.T + middle
    return own


def test_every_pixel_shows_the_nearest_face_of_the_room(room, cameras):
    solids = room.solids
    for camera in cameras[::4]:
        seen = room.view_from(camera)
        points = points_seen(camera, seen.depth)
        for face in np.unique(seen.face):
            solid, axis, side = face // 6, face % 6 // 2, face % 2
            own = in_box(solids, solid, points[seen.face == face])
            plane = (solids.high if side else solids.low)[solid, axis]
            np.testing.assert_allclose(own[:, axis], plane, atol=1e-4)
            assert (own > solids.low[solid] - 1e-4).all()
            assert (own < solids.high[solid] + 1e-4).all()
        for share in (0.3, 0.6, 0.9, 0.99):
            between = camera.center_world + share * (points - camera.center_world)
            for solid in range(1, len(solids.low)):
                own = in_box(solids, solid, between)
                inside = (own > solids.low[solid] + 1e-3) & (own < solids.high[solid] - 1e-3)
                assert not inside.all(axis=-1).any()


@pytest.mark.parametrize("subject", [1, 2])
def test_the_phone_walks_an_arc_and_holds_the_person_in_the_picture(subject):
    actor = Actor.of(subject)
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
    for row, camera in enumerate(cameras):
        assert camera.size_px == (960, 540)
        pixels = camera.project(actor.vertices(motion[row]))
        assert pixels.min() > 5.0
        assert (pixels < [955.0, 535.0]).all()
        assert np.ptp(pixels[:, 1]) > 0.65 * 540
        assert abs(actor.sole_height_m(motion[row])) < 1e-9


def test_the_cameras_are_written_to_the_ground_truth_only(capture):
    assert {path.name for path in capture.iterdir()} == {
        "video.mp4", "preview.webm", "masks", "poses.npz", "dance.npz", "truth", LIST
    }  # fmt: skip
    with np.load(capture / "poses.npz") as poses:
        assert "camera" not in poses
        assert str(poses["space"]) == "camera"
    track = read_cameras(capture / "truth" / "cameras.npz", (128, 72))
    assert len(track.cameras) == WALK.frames
    given, truth = (read_motion(capture / name) for name in ("poses.npz", "truth/poses.npz"))
    np.testing.assert_allclose(given.intrinsic, track[0].intrinsic)
    shaped = Actor.of(1).shaped
    for row, camera in enumerate(track.cameras):
        inside = shaped.with_pose(given[row]).joints()
        world = shaped.with_pose(truth[row]).joints()
        view = camera.camera_from_world
        np.testing.assert_allclose(inside, world @ view[:3, :3].T + view[:3, 3], atol=1e-9)


def test_true_cameras_and_none_see_the_same_person(capture):
    true = capture / "truth" / "cameras.npz"
    recordings = [
        open_capture(CaptureInputs(video=capture, cameras=cameras)) for cameras in (str(true), None)
    ]
    assert [recording.cameras.is_moving for recording in recordings] == [True, False]
    truth = read_motion(capture / "truth" / "poses.npz")
    np.testing.assert_allclose(
        recordings[0].motion.root_translations, truth.root_translations, atol=1e-9
    )
    for one, other in zip(*(each.observations() for each in recordings), strict=True):
        assert isinstance(one, Observation)
        assert isinstance(other, Observation)
        pixels = [
            seen.camera.project(which.shaped.with_pose(seen.pose).joints())
            for seen, which in ((one, recordings[0]), (other, recordings[1]))
        ]
        np.testing.assert_allclose(*pixels, atol=1e-6)


def test_a_painted_backdrop_is_refused_where_the_camera_moves(tmp_path):
    for background in ("plain", "clutter"):
        config = ShootConfig(motion="walkaround", background=background)
        with pytest.raises(InputError, match=r"room or tiles"):
            film_capture(tmp_path / "c", config)


def test_a_pose_file_says_in_which_space_it_is(capture, tmp_path):
    assert read_motion(capture / "poses.npz").space == "camera"
    with np.load(capture / "poses.npz") as arrays:
        changed = {**arrays, "space": np.array("moon")}
    np.savez(tmp_path / "poses.npz", **changed)
    with pytest.raises(InputError, match=r"expected world or camera"):
        read_motion(tmp_path / "poses.npz")

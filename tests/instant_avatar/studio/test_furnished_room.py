"""The room and the phone that is carried around in it."""

import cv2
import numpy as np
import pytest

from capture.atomic_files import LIST_NAME as LIST
from capture.input_error import InputError
from instant_avatar.studio import staging
from instant_avatar.studio.actor import Actor
from instant_avatar.studio.furnished_room import SENSOR_NOISE, FurnishedRoom
from instant_avatar.studio.painted_surfaces import dead_leaves, repeat_motif
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


def test_the_corners_of_the_furniture_are_where_the_cameras_project_them(room, cameras):
    """Around the projection of a free upper corner lie three faces or two and what is behind."""
    solids, met = room.solids, 0
    for camera in cameras:
        seen = room.view_from(camera)
        for solid in (2, 5, 6, 15):
            low, high = solids.low[solid], solids.high[solid]
            cosine, sine = solids.yaw_cos_sin[solid]
            for x, z in (
                (low[0], low[2]),
                (low[0], high[2]),
                (high[0], low[2]),
                (high[0], high[2]),
            ):
                away = np.array([x, z]) - solids.centers_xz[solid]
                x, z = np.array([[cosine, sine], [-sine, cosine]]) @ away + solids.centers_xz[solid]
                corner = np.array([x, high[1], z])
                depth = camera.camera_from_world[2] @ [*corner, 1.0]
                column, row = camera.project(corner)
                if not (3 < column < 189 and 3 < row < 105):
                    continue
                around = np.s_[int(row) - 2 : int(row) + 3, int(column) - 2 : int(column) + 3]
                if abs(seen.depth[around] - depth).min() > 0.1:
                    continue  # something stands before it
                met += 1
                faces = np.unique(seen.face[around])
                assert (faces // 6 == solid).any()
                assert len(faces) >= 2
    assert met > 20


def test_a_place_of_the_wall_has_one_color_from_everywhere(room):
    near = staging.handheld_cameras(np.zeros((60, 2)), 1.8, 384, 1)[28:31:2]
    first, second = (room.view_from(camera) for camera in near)
    first = type(first)(rgb=first.rgb.copy(), depth=first.depth, face=first.face)
    points = points_seen(near[0], first.depth)
    pixels = near[1].project(points).astype(np.float32) - np.float32(0.5)
    moved = cv2.remap(second.rgb, pixels, None, cv2.INTER_LINEAR)
    depth = cv2.remap(second.depth, pixels, None, cv2.INTER_NEAREST, borderValue=0.0)
    there = points @ near[1].camera_from_world[2, :3] + near[1].camera_from_world[2, 3]
    both = (abs(depth - there) < 0.02) & (abs(pixels - pixels.round()) < 1).all(axis=-1)
    assert both.mean() > 0.5
    off = abs(moved - first.rgb)[both]
    assert np.median(off) < 4.0
    assert first.rgb[both].std() > 25.0


def test_nothing_in_the_room_repeats_and_all_of_the_tiles_do():
    generator = np.random.default_rng(0)
    motif = dead_leaves((120, 120, 120))
    tiled = repeat_motif(motif, 0.3, (0, 0, 0))((200, 100), 0.01, generator)
    np.testing.assert_array_equal(tiled[:, 30:], tiled[:, :-30])
    np.testing.assert_array_equal(tiled[30:], tiled[:-30])
    free = motif((200, 100), 0.01, generator).astype(float)
    free = (free - free.mean()) / free.std()
    for shift in range(10, 100):
        assert (free[:, shift:] * free[:, :-shift]).mean() < 0.6


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


def test_the_person_is_drawn_over_the_room_unchanged(capture):
    actor = Actor.of(1)
    truth = read_motion(capture / "truth" / "poses.npz")
    track = read_cameras(capture / "truth" / "cameras.npz", (128, 72))
    video = cv2.VideoCapture(str(capture / "video.mp4"))
    room = FurnishedRoom.furnished("room", 128, 0)
    for row in range(WALK.frames):
        frame = video.read()[1][..., ::-1]
        rgb, alpha = actor.render_over(truth[row], track[row])
        mask = cv2.imread(str(capture / "masks" / f"{row:04d}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(mask, alpha)
        np.testing.assert_array_equal(frame[mask == 255], rgb[mask == 255])
        behind = room.view_from(track[row]).rgb
        free = (mask == 0) & (room.view_from(track[row]).face != 2)
        assert abs((frame.astype(float) - behind)[free]).std() < 2.0 * SENSOR_NOISE


def test_a_still_camera_sees_the_same_room_under_new_noise(tmp_path):
    film_capture(tmp_path / "c", ShootConfig(frames=3, size=64, background="room"))
    assert (tmp_path / "c" / "cameras.npz").exists()
    video = cv2.VideoCapture(str(tmp_path / "c" / "video.mp4"))
    frames = np.stack([video.read()[1] for _ in range(3)]).astype(float)
    upper = frames[:, :20, :16] - frames[:1, :20, :16]  # a wall, away from actor and floor
    assert 0.7 * SENSOR_NOISE * np.sqrt(2) < upper[1:].std() < 1.4 * SENSOR_NOISE * np.sqrt(2)
    assert frames[0].std() > 20.0


def test_the_same_seed_walks_the_same_and_another_does_not(capture, tmp_path):
    film_capture(tmp_path / "again", WALK)
    film_capture(tmp_path / "other", ShootConfig(frames=6, size=128, motion="walkaround", seed=1))
    for name, same in (("again", True), ("other", False)):
        for file in ("video.mp4", "truth/cameras.npz"):
            bytes_ = [(folder / file).read_bytes() for folder in (capture, tmp_path / name)]
            assert (bytes_[0] == bytes_[1]) == same


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

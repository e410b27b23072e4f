"""Tests for placing one camera by known points, and for following points between key frames."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from preprocess.sfm.colmap_mapping import SfmKeyframe
from preprocess.sfm.point_tracking import (
    detect_corners,
    resect_camera,
    resect_intermediate_frames,
    track_points,
)
from preprocess.sfm.turning_camera import MAX_STATIC_MOTION, measure_background_motion
from tests.preprocess.sfm.conftest import exact_model, walked


def apart(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Millimetres between two cameras' centres, and degrees between their rotations."""
    centers = [-view[:3, :3].T @ view[:3, 3] for view in (a, b)]
    turn = Rotation.from_matrix(a[:3, :3] @ b[:3, :3].T).magnitude()
    return 1000.0 * float(np.linalg.norm(centers[0] - centers[1])), float(np.degrees(turn))


@pytest.mark.parametrize("bend", [0.0, -0.08])
def test_a_camera_is_placed_exactly_though_a_third_of_the_points_is_wrong(
    cameras, room_points, rng, bend
):
    lens = replace(cameras[3], distortion=(bend, 0.0, 0.0, 0.0) if bend else ())
    view = lens.camera_from_world
    ahead = room_points @ view[2, :3] + view[2, 3] > 0.5
    straight = cameras[3].project(room_points[ahead])  # far outside, the lens folds
    inside = ((straight > 0.0) & (straight < lens.size_px)).all(axis=1)
    pixels = lens.project(room_points[ahead])
    points, pixels = room_points[ahead][inside], pixels[inside]
    wrong = rng.random(len(points)) < 0.33
    pixels[wrong] += rng.normal(size=(wrong.sum(), 2)) * 60.0
    millimetres, degrees = apart(resect_camera(points, pixels, lens), view)
    assert millimetres < 0.1
    assert degrees < 0.01


def test_points_that_contradict_each_other_place_nothing(cameras, room_points, rng):
    pixels = rng.uniform(0.0, 400.0, (len(room_points), 2))
    assert resect_camera(room_points, pixels, cameras[0]) is None
    assert resect_camera(room_points[:10], cameras[0].project(room_points[:10]), cameras[0]) is None


def test_points_that_are_covered_are_lost(room, cameras):
    picture = cv2.cvtColor(room.seen(cameras[0]), cv2.COLOR_RGB2GRAY)
    covered = picture.copy()
    covered[:, :320] = 90
    pixels = detect_corners(picture, np.ones(picture.shape, dtype=bool), 300)
    _, found = track_points(picture, covered, pixels)
    right = pixels[:, 0] > 400.0
    assert found[right].mean() > 0.9
    assert not found[pixels[:, 0] < 300.0].any()


def shown(room, cameras) -> list[SfmKeyframe]:
    """Pictures with a person that goes from left to right."""
    keys = []
    for index, camera in enumerate(cameras):
        grey = cv2.cvtColor(room.seen(camera), cv2.COLOR_RGB2GRAY)
        person = np.zeros(grey.shape, dtype=bool)
        left = 20 + 5 * index
        person[60:200, left : left + 60] = True
        texture = np.random.default_rng(5).integers(0, 255, (140, 60), dtype=np.uint8)
        grey[60:200, left : left + 60] = texture
        keys.append(SfmKeyframe(index=index, gray=grey, person_mask=person))
    return keys


def test_a_tripod_is_known_though_the_person_moves(room):
    camera = walked(2, degrees=0.0, size_px=(320, 240), focal_px=260.0)[0]
    assert measure_background_motion(shown(room, [camera] * 6)) < 1e-3


def test_a_camera_that_walks_or_trembles_is_no_tripod(room):
    for degrees in (45.0, 0.0):  # round the room; on the spot, by 2 cm each way
        cameras = walked(6, degrees=degrees, size_px=(320, 240), focal_px=260.0)
        assert not measure_background_motion(shown(room, cameras)) <= MAX_STATIC_MOTION


@pytest.fixture(scope="module")
def film(room, tmp_path_factory):
    cameras = walked(15, degrees=14, size_px=(320, 240), focal_px=260.0)
    return cameras, room.film(tmp_path_factory.mktemp("film"), cameras)


ROWS = [0, 6, 12]


def keyed(film, cameras, room_points):
    """Some frames are known exactly, with the corners of their pictures as points."""
    keys, seen = [], []
    for frame in film.frames():
        if frame.index in ROWS:
            grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
            keys.append(
                SfmKeyframe(index=frame.index, gray=grey, person_mask=np.zeros(grey.shape, bool))
            )
            seen.append(cameras[frame.index])
    model = exact_model(seen, room_points)
    return keys, replace(model, frames=np.array(ROWS))


def test_frames_between_key_frames_are_placed_to_millimetres(film, room_points):
    cameras, source = film
    keys, model = keyed(source, cameras, room_points)
    found = resect_intermediate_frames(source, model, keys, lambda share: None)
    assert sorted(found.cameras) == [i for i in range(15) if i not in ROWS]  # those at the end, too
    off = np.array([apart(found.cameras[i], cameras[i].camera_from_world) for i in found.cameras])
    assert np.median(off[:, 0]) < 4.0
    assert off[:, 0].max() < 20.0
    assert np.median(off[:, 1]) < 0.1
    assert sorted(found.keyframe_errors_px) == ROWS[1:]
    assert max(found.keyframe_errors_px.values()) < 0.6

"""The metric world of solved cameras: its scale by closed forms, and the floor."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from preprocess.sfm.metric_world import (
    SOLE_THICKNESS_M,
    FloorPlane,
    PersonInCameras,
    estimate_metric_scale,
    fit_floor_plane,
    mean_camera_up,
    to_metric_world,
    upright_axes,
)
from tests.preprocess.sfm.conftest import exact_model

TRUE = 0.4
"""Metres per unit of the solved world."""
FLOOR = FloorPlane(normal=np.array([0.0, 1.0, 0.0]), offset=0.0, points=500)


def filmed(cameras, *, at=None, depth=None, soles_m=SOLE_THICKNESS_M) -> PersonInCameras:
    """A person as a tracker tells it, in a solved world whose unit is 0.4 m.

    Args:
        cameras: In metres.
        at: Where the person stands on the floor in each frame, metres; the origin if None.
        depth: By what the tracker multiplies each frame's distances.
        soles_m: How high the soles are above the floor.
    """
    count = len(cameras)
    at = np.zeros((count, 3)) if at is None else at
    depth = np.ones(count) if depth is None else depth
    pelves, soles = [], []
    for row, camera in enumerate(cameras):
        view = camera.camera_from_world
        feet = [[-0.1, soles_m, 0.05], [0.1, soles_m + 0.3, 0.0], [0.1, soles_m + 0.02, 0.1]]
        for points, into in (([[0.0, 0.95, 0.0]], pelves), (feet, soles)):
            seen = (np.array(points) + at[row]) @ view[:3, :3].T + view[:3, 3]
            into.append(depth[row] * seen)
    turned = np.stack([camera.camera_from_world[:3, :3].T for camera in cameras])
    return PersonInCameras(
        world_from_camera=turned,
        centers=np.stack([camera.center_world for camera in cameras]) / TRUE,
        pelvis_positions=np.array(pelves)[:, 0],
        soles=np.array(soles),
    )


def test_exact_poses_give_the_exact_scale_by_both_cues(cameras):
    scale = estimate_metric_scale(filmed(cameras), FLOOR)
    assert scale.cues == ("ground", "in place")
    assert scale.rejection_reason is None
    for found in (scale.metres_per_unit, scale.ground, scale.place):
        assert found == pytest.approx(TRUE, rel=1e-9)
    assert scale.spread < 1e-9


def test_who_walks_is_measured_by_the_ground_alone(cameras):
    # with the camera, so that its place says something, and something wrong
    centers = np.stack([camera.center_world for camera in cameras])
    along = 0.3 * (centers - centers.mean(axis=0)) * [1.0, 0.0, 1.0]
    scale = estimate_metric_scale(filmed(cameras, at=along), FLOOR)
    assert scale.cues == ("ground",)
    assert scale.metres_per_unit == pytest.approx(TRUE, rel=1e-9)
    assert abs(scale.place / TRUE - 1.0) > 0.1


def test_feet_in_the_air_now_and_then_do_not_count(cameras):
    jumps = np.zeros((len(cameras), 3))
    jumps[::3, 1] = 0.4
    scale = estimate_metric_scale(filmed(cameras, at=jumps), FLOOR)
    assert scale.ground == pytest.approx(TRUE, rel=1e-9)


def test_without_a_floor_a_person_in_place_tells(cameras):
    scale = estimate_metric_scale(filmed(cameras), None)
    assert scale.cues == ("in place",)
    assert scale.metres_per_unit == pytest.approx(TRUE, rel=1e-9)


def test_an_unknown_metric_scale_is_reported(cameras, rng):
    wandering = np.cumsum(rng.normal(size=(len(cameras), 3)), axis=0) * [1.0, 0.0, 1.0]
    scale = estimate_metric_scale(filmed(cameras, at=wandering), None)
    assert "floor was not seen" in scale.rejection_reason


def test_a_common_error_of_depth_is_the_error_of_the_scale(cameras):
    biased = estimate_metric_scale(filmed(cameras, depth=np.full(len(cameras), 1.02)), FLOOR)
    assert biased.metres_per_unit == pytest.approx(1.02 * TRUE, rel=1e-3)  # soles do not grow


def test_errors_of_single_frames_average_out(cameras):
    rng = np.random.default_rng(4)
    errors = 1.0 + 0.05 * rng.normal(size=(60, len(cameras)))
    found = [estimate_metric_scale(filmed(cameras, depth=depth), FLOOR) for depth in errors]
    ratios = np.array([scale.metres_per_unit for scale in found]) / TRUE
    assert abs(ratios.mean() - 1.0) < 0.01
    assert ratios.std() < 0.03
    assert all(scale.rejection_reason is None for scale in found)


UP = np.array([0.0, 1.0, 0.0])


def test_the_floor_is_found_among_walls(cameras, room_points, rng):
    rough = room_points + 0.004 * rng.normal(size=room_points.shape)
    model = exact_model(cameras, rough)
    floor = fit_floor_plane(model, mean_camera_up(model))
    assert np.degrees(np.arccos(floor.normal @ UP)) < 0.3
    assert abs(floor.offset) < 0.005
    assert floor.points > 100
    assert floor.heights_above(np.array([[0.0, 1.5, 0.0]])) == pytest.approx([1.5], abs=0.01)


@pytest.mark.slow
def test_a_table_is_no_floor(cameras, room_points, rng):
    table = rng.uniform([-2.5, 0.75, -2.5], [2.5, 0.75, 0.5], (700, 3))  # larger than the floor
    floor = fit_floor_plane(exact_model(cameras, np.concatenate([room_points, table])), UP)
    assert abs(floor.offset) < 0.005


def test_no_floor_is_made_up(cameras, room_points):
    walls = room_points[(room_points[:, 1] > 0.3)]
    assert fit_floor_plane(exact_model(cameras, walls), UP) is None


def test_the_metric_world_shows_the_same_pictures(cameras, model, room_points):
    turn, scale = Rotation.from_rotvec([0.4, 1.0, -0.3]).as_matrix(), 0.25
    shrunk = []
    for camera in cameras:
        view = camera.camera_from_world.copy()
        view[:3, :3], view[:3, 3] = view[:3, :3] @ turn.T, scale * view[:3, 3]
        shrunk.append(replace(camera, camera_from_world=view))
    points = scale * room_points @ turn.T
    solved = exact_model(shrunk, points)
    floor = FloorPlane(normal=turn @ UP, offset=0.0, points=300)
    person = scale * turn @ np.array([0.3, 0.95, -0.2])
    found = to_metric_world(solved.camera_from_world, 1.0 / scale, floor, person)
    there = np.stack([replace(cameras[0], camera_from_world=view).center_world for view in found])
    true = np.stack([camera.center_world for camera in cameras])
    np.testing.assert_allclose(there[:, 1], true[:, 1], atol=1e-6)  # over the floor
    away = np.linalg.norm(true - [0.3, 0.0, -0.2], axis=1)  # the person is over the origin
    np.testing.assert_allclose(np.linalg.norm(there, axis=1), away, atol=1e-6)
    assert abs(there[0, 0]) < 1e-6  # z points to the first camera
    for row in (0, 9, 23):  # and each camera sees what it saw
        axes = upright_axes(floor.normal, turn @ (true[0] - [0.3, 0.0, -0.2]))
        origin = turn @ np.array([0.3, 0.0, -0.2])
        moved = (points / scale - origin) @ axes.T
        camera = replace(cameras[row], camera_from_world=found[row])
        np.testing.assert_allclose(
            camera.project(moved), cameras[row].project(room_points), atol=1e-3
        )

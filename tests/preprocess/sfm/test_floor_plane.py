"""Tests for the floor, and for the world that is built on it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from preprocess.sfm.metric_world import (
    FloorPlane,
    fit_floor_plane,
    mean_camera_up,
    to_metric_world,
    upright_axes,
)

UP = np.array([0.0, 1.0, 0.0])


def test_the_floor_is_found_among_walls(cameras, room_points, exact_model, rng):
    rough = room_points + 0.004 * rng.normal(size=room_points.shape)
    floor = fit_floor_plane(
        exact_model(cameras, rough), mean_camera_up(exact_model(cameras, rough))
    )
    assert np.degrees(np.arccos(floor.normal @ UP)) < 0.3
    assert abs(floor.offset) < 0.005
    assert floor.points > 100
    assert floor.heights_above(np.array([[0.0, 1.5, 0.0]])) == pytest.approx([1.5], abs=0.01)


def test_a_table_is_no_floor(cameras, room_points, exact_model, rng):
    table = rng.uniform([-2.5, 0.75, -2.5], [2.5, 0.75, 0.5], (700, 3))  # larger than the floor
    floor = fit_floor_plane(exact_model(cameras, np.concatenate([room_points, table])), UP)
    assert abs(floor.offset) < 0.005


def test_no_floor_is_made_up(cameras, room_points, exact_model):
    walls = room_points[(room_points[:, 1] > 0.3)]
    assert fit_floor_plane(exact_model(cameras, walls), UP) is None


def test_axes_are_a_rotation_with_y_up(rng):
    for _ in range(20):
        up, towards = rng.normal(size=(2, 3))
        up /= np.linalg.norm(up)
        axes = upright_axes(up, towards)
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1.0)
        np.testing.assert_allclose(axes @ up, UP, atol=1e-12)
        seen = axes @ towards
        assert abs(seen[0]) < 1e-9  # neither left nor right of z
        assert seen[2] > 0.0


def test_the_metric_world_shows_the_same_pictures(cameras, model, room_points, exact_model):
    turn, scale = Rotation.from_rotvec([0.4, 1.0, -0.3]).as_matrix(), 0.25
    shrunk = [
        replace(
            camera,
            camera_from_world=np.block(
                [
                    [camera.camera_from_world[:3, :3] @ turn.T,
                     camera.camera_from_world[:3, 3:] * scale],
                    [np.zeros((1, 3)), np.ones((1, 1))],
                ]
            ),
        )
        for camera in cameras
    ]  # fmt: skip
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

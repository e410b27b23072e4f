"""Tests for the metric scale: closed forms, and what a tracker's errors make of it."""

import numpy as np
import pytest

from preprocess.sfm.metric_world import (
    SOLE_THICKNESS_M,
    FloorPlane,
    PersonInCameras,
    estimate_metric_scale,
)

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
    found = [
        estimate_metric_scale(
            filmed(cameras, depth=1.0 + 0.05 * rng.normal(size=len(cameras))), FLOOR
        )
        for _ in range(60)
    ]
    ratios = np.array([scale.metres_per_unit for scale in found]) / TRUE
    assert abs(ratios.mean() - 1.0) < 0.01
    assert ratios.std() < 0.03
    assert all(scale.rejection_reason is None for scale in found)

"""Tests for small silhouettes: area, place, agreement."""

import cv2
import numpy as np
import pytest
import trimesh

from capture.camera import Camera
from preprocess.body.body_pose import BodyPose
from preprocess.body.body_surface import (
    SkinPoints,
    smooth_over_surface,
    soft_iou,
    splat_silhouette,
    vertex_normals,
    visible_points,
)


@pytest.fixture(scope="module")
def skin(shaped) -> SkinPoints:
    return SkinPoints.of(shaped)


@pytest.fixture
def camera() -> Camera:
    """Upright, 3 m in front of the body, which is about 96 px high."""
    return Camera.at(np.array([0.0, -0.1, 3.0]), np.diag([1.0, -1.0, -1.0]), 160.0, (128, 128))


def test_points_are_spread_evenly_over_the_skin(skin, shaped):
    corners = shaped.vertices[shaped.body.faces]
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(sides, axis=1)
    center = (corners.mean(axis=1) * area[:, None]).sum(axis=0) / area.sum()
    np.testing.assert_allclose(skin.rest.mean(axis=0), center, atol=2e-3)


def test_points_move_with_the_skin(skin, shaped, rng):
    turn, place, joints = rng.normal(size=3), rng.normal(size=3), 0.4 * rng.normal(size=(23, 3))
    pose = BodyPose(root_rotation=turn, root_translation=place, joint_rotations=joints)
    posed, points = shaped.with_pose(pose).vertices(), skin.posed(pose)
    assert np.linalg.norm(points[:50, None] - posed[None], axis=-1).min(axis=1).max() < 0.04


def test_splatted_and_exact_silhouettes_agree(skin, shaped, camera):
    drawn = splat_silhouette(skin.posed(BodyPose.rest()), camera)
    exact = np.zeros((128 * 8, 128 * 8), np.uint8)
    pixels = (camera.project(shaped.vertices) * 8).astype(np.int32)
    for face in shaped.body.faces:
        cv2.fillConvexPoly(exact, pixels[face], 1)
    alpha = cv2.resize(exact.astype(np.float32), (128, 128), interpolation=cv2.INTER_AREA)
    assert soft_iou(drawn, alpha) > 0.88  # the rim's pixels are drawn whole
    assert soft_iou(drawn, (alpha > 0).astype(np.float32)) > 0.95


def test_nothing_is_drawn_of_a_person_behind_the_camera(skin, camera):
    behind = skin.posed(BodyPose.rest()) + np.array([0.0, 0.0, 10.0], dtype=np.float32)
    assert not splat_silhouette(behind, camera).any()


def test_a_lens_bends_the_silhouette_as_it_bends_points(skin, camera):
    bent = Camera(**{**vars(camera), "distortion": (-0.2, 0.0, 0.0, 0.0)})
    points = skin.posed(BodyPose.rest())
    pixels = bent.project(points.astype(np.float64))
    drawn = splat_silhouette(points, bent)
    assert drawn[tuple(np.floor(pixels[:, ::-1]).astype(int).T)].all()


def test_soft_iou_of_hard_masks_is_that_of_sets(rng):
    a, b = rng.random((40, 40)) > 0.5, rng.random((40, 40)) > 0.5
    assert soft_iou(a, b.astype(np.float32)) == pytest.approx((a & b).sum() / (a | b).sum())
    assert soft_iou(a, a.astype(np.float32)) == 1.0
    assert soft_iou(a & False, np.zeros((40, 40), np.float32)) == 0.0


def test_a_surface_is_smoothed_as_heat_spreads_on_a_sphere():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    values = np.column_stack([vertex_normals(vertices, faces), np.ones(len(vertices))])
    smooth = smooth_over_surface(vertices, faces, values, 0.02)
    np.testing.assert_allclose(smooth[:, 3], 1.0, atol=1e-9)
    # a normal is a spherical harmonic of degree 1, of eigenvalue 2 / r²
    np.testing.assert_allclose(smooth[:, :3], values[:, :3] / (1.0 + 0.02**2 / 0.05**2), atol=5e-3)


def test_what_lies_behind_a_limb_is_hidden_beside_it_too():
    """A near strip 0.3 m before a far wall: clothes and a wrong pose may widen the strip."""
    wall = np.stack(np.meshgrid(np.arange(0.01, 0.6, 0.02), np.arange(0.01, 0.3, 0.02)), -1)
    wall = wall.reshape(-1, 2)
    strip = wall[(wall[:, 0] > 0.24) & (wall[:, 0] < 0.36)]
    points = np.concatenate([wall, strip])
    depth = np.repeat([2.3, 2.0], [len(wall), len(strip)])
    facing = np.ones(len(points))
    hard = visible_points(points, depth, facing)[: len(wall)]
    wide = visible_points(points, depth, facing, margin_cells=1)[: len(wall)]
    beside = np.maximum(0.25 - wall[:, 0], wall[:, 0] - 0.35)
    assert not hard[beside < 0.01].any()
    assert hard[beside > 0.03].all()
    assert not wide[beside < 0.03].any()
    assert wide[beside > 0.06].all()
    assert visible_points(points, depth, facing, margin_cells=1)[len(wall) :].all()


def test_a_slanted_surface_hides_nothing_of_itself():
    plane = np.stack(np.meshgrid(np.arange(0.01, 0.6, 0.02), np.arange(0.01, 0.3, 0.02)), -1)
    plane = plane.reshape(-1, 2)
    depth, cosine = 2.0 + 1.2 * plane[:, 0], np.full(len(plane), 1.0 / np.hypot(1.0, 1.2))
    assert visible_points(plane, depth, cosine, margin_cells=1).all()

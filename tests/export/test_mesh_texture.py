"""Textures of meshes."""

import numpy as np
import pytest
import trimesh

from export.mesh_texture import TEXEL_M, draw_texture, unwrap

SIDE_M = 0.2


def show_nothing(camera):
    return np.zeros((*camera.size_px[::-1], 4), dtype=np.uint8)


def test_a_single_texel_that_sees_another_color_is_not_shown():
    pytest.importorskip("xatlas")
    ends = [0.0, SIDE_M]
    positions = np.array([[x, y, 0.0] for x in ends for y in ends], dtype=np.float32)
    mesh = unwrap(positions, np.array([[0, 2, 1], [1, 2, 3]], dtype=np.int32))

    def color_at(points, _):
        there = np.linalg.norm(points[:, :2] - SIDE_M / 2.0, axis=1) < 0.6 * TEXEL_M
        seen.append(there.sum())
        left = points[:, :1] < SIDE_M / 4.0
        return np.where(there[:, None], 255, np.where(left, 40, 120)).repeat(3, 1).astype(np.uint8)

    seen = []
    upwards = np.tile(np.float32([0.0, 0.0, 1.0]), (len(mesh.sources), 1))
    texture = draw_texture(mesh, positions[mesh.sources], upwards, color_at, show_nothing)
    assert 1 <= sum(seen) <= 4
    assert np.unique(texture.image).tolist() == [40, 120]
    assert (texture.image == 40).mean() == pytest.approx(0.25, abs=0.05)


def test_a_texture_shows_what_pictures_show_where_they_see_it():
    pytest.importorskip("xatlas")
    balls = [trimesh.creation.icosphere(3, radius) for radius in (0.1, 0.05)]
    outside = len(balls[0].faces)
    positions = np.concatenate([ball.vertices for ball in balls]).astype(np.float32)
    faces = np.concatenate([balls[0].faces, balls[1].faces + len(balls[0].vertices)])
    mesh = unwrap(positions, faces.astype(np.int32))
    places = positions[mesh.sources]
    normals = places / np.linalg.norm(places, axis=1, keepdims=True)

    def show_blue(camera):
        return np.broadcast_to(np.uint8([0, 0, 200, 255]), (*camera.size_px[::-1], 4))

    def gray(points, _):
        return np.full((len(points), 3), 90, dtype=np.uint8)

    image = draw_texture(mesh, places, normals, gray, show_blue).image
    column, row = (mesh.coordinates[mesh.faces].mean(axis=1) * mesh.side_px).astype(int).T
    shown = image[row, column].astype(float)
    assert np.abs(shown[:outside] - [0.0, 0.0, 200.0]).max() < 40.0  # 200 - 90 without pictures
    assert np.abs(shown[outside:] - 90.0).max() <= 1.0  # from nowhere seen

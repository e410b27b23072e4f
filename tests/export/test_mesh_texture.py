"""Textures of meshes."""

import numpy as np
import pytest

from export.mesh_texture import TEXEL_M, draw_texture, unwrap

SIDE_M = 0.2


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
    texture = draw_texture(mesh, positions[mesh.sources], upwards, color_at)
    assert 1 <= sum(seen) <= 4
    assert np.unique(texture.image).tolist() == [40, 120]
    assert (texture.image == 40).mean() == pytest.approx(0.25, abs=0.05)

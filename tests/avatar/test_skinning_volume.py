"""Skinning and distance volumes of bodies so simple that the answer is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avatar.rig import BLENDED_VERTICES, MIN_VERTEX_DISTANCE_M, skinning_weight_volume, volume_shape

LOW, HIGH = np.array([-0.5, -0.3, -0.2]), np.array([0.5, 0.3, 0.2])
CELL_M = 0.05


def one_hot(joint, count=1):
    weights = np.zeros((count, 24))
    weights[:, joint] = 1.0
    return weights


def volume(vertices, weights, reach_m=10.0):
    return skinning_weight_volume(vertices, weights, LOW, HIGH, CELL_M, reach_m)


def two_blobs():
    """Thirty vertices of joint 4 at -x, thirty of joint 7 at the mirrored places."""
    left = np.random.default_rng(0).normal(size=(BLENDED_VERTICES, 3)) * 0.01 + [-0.2, 0.0, 0.0]
    right = left * [-1.0, 1.0, 1.0]
    return np.concatenate([left, right]), np.concatenate(
        [one_hot(4, BLENDED_VERTICES), one_hot(7, BLENDED_VERTICES)]
    )


@given(st.floats(0.01, 0.2))
def test_volumes_have_cells_of_about_the_size_asked_for(cell_m):
    shape = np.array(volume_shape(LOW, HIGH, cell_m))
    size = (HIGH - LOW) / shape
    assert (size <= cell_m * (1 + 1e-9)).all()
    assert ((HIGH - LOW) / (shape - 1 + 1e-12) >= cell_m * (1 - 1e-9)).all()


def test_out_of_reach_everything_hangs_on_the_root():
    vertices = np.random.default_rng(1).normal(size=(40, 3)) * 0.01
    weights = volume(vertices, one_hot(5, 40), reach_m=0.22)
    assert (weights[..., 0] + weights[..., 5]) == pytest.approx(np.ones(weights.shape[:3]))
    assert weights[0, 0, 0, 0] == 1.0
    assert weights[10, 6, 4, 5] == pytest.approx(1.0, abs=1e-6)


def test_a_mirrored_body_has_mirrored_weights():
    weights = volume(*two_blobs())
    np.testing.assert_allclose(weights[..., 4], weights[::-1, :, :, 7], atol=1e-5)
    np.testing.assert_allclose(weights[10, :, :, 4], 0.5, atol=1e-5)  # the plane between them


def test_weights_fall_with_the_square_of_the_distance():
    """One vertex against the others at three times its distance: each of those weighs a ninth."""
    node = np.array([0.0, 0.0, 0.0])
    around = np.random.default_rng(2).normal(size=(BLENDED_VERTICES - 1, 3))
    around *= 0.3 / np.linalg.norm(around, axis=1, keepdims=True)
    vertices = np.concatenate([[[0.1, 0.0, 0.0]], around]) + node
    weights = np.concatenate([one_hot(9), one_hot(2, BLENDED_VERTICES - 1)])
    share = skinning_weight_volume(vertices, weights, -1e-4 + node, 1e-4 + node, 1e-4, 10.0)
    np.testing.assert_allclose(share[..., 9], 1.0 / (1.0 + (BLENDED_VERTICES - 1) / 9.0), atol=1e-3)


def test_a_node_on_a_vertex_is_not_taken_by_it_alone():
    around = np.random.default_rng(2).normal(size=(BLENDED_VERTICES - 1, 3))
    around *= 0.02 / np.linalg.norm(around, axis=1, keepdims=True)
    vertices = np.concatenate([np.zeros((1, 3)), around])
    weights = np.concatenate([one_hot(9), one_hot(2, BLENDED_VERTICES - 1)])
    end = np.full(3, 1e-5)
    share = skinning_weight_volume(vertices, weights, -end, end, 1e-5, 10.0)
    own, others = MIN_VERTEX_DISTANCE_M**-2, (BLENDED_VERTICES - 1) * 0.02**-2
    np.testing.assert_allclose(share[..., 9], own / (own + others), atol=1e-3)

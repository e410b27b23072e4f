"""Girths: hair and clothes thicken a body, and leave its features what they are."""

import numpy as np
import pytest

from preprocess.body.kinematics import HEAD_JOINT
from preprocess.body.proportion_space import GIRTH_GROUPS, ProportionSpace

THICKER = 1.5


@pytest.fixture
def space(mean_body):
    return ProportionSpace.around(mean_body)


def moved_by(space, group):
    """Displacement of the skin by a girth, metres."""
    coefficients = np.zeros(space.count)
    row = list(GIRTH_GROUPS).index(group)
    coefficients[space.count - len(GIRTH_GROUPS) + row] = THICKER
    return space.shape(coefficients).vertices - space.shaped.vertices


def test_hair_covers_the_skull_and_not_the_face(space):
    moved, vertices = moved_by(space, "head"), space.shaped.vertices
    weight = space.shaped.body.weights[:, HEAD_JOINT]
    nose = np.where(weight > 0.9, vertices[:, 2], -np.inf).argmax()
    crown = np.where(weight > 0.9, vertices[:, 1], -np.inf).argmax()
    back = np.where(weight > 0.9, -vertices[:, 2], -np.inf).argmax()
    assert np.linalg.norm(moved[nose]) < 0.004
    assert 0.02 < moved[crown, 1] < 0.032
    assert -0.032 < moved[back, 2] < -0.02


@pytest.mark.parametrize("group", ["head", "hands", "feet"])
def test_no_feature_is_inflated(space, group):
    """Neighbors move nearly alike: normals of their own would tear ears and fuse fingers."""
    moved, body = moved_by(space, group), space.shaped.body
    edges = np.concatenate([body.faces[:, [0, 1]], body.faces[:, [1, 2]]])
    lengths = np.linalg.norm(np.diff(space.shaped.vertices[edges], axis=1), axis=2)[:, 0]
    apart = np.linalg.norm(np.diff(moved[edges], axis=1), axis=2)[:, 0]
    fine = (lengths > 0.002) & (lengths < 0.008) & (apart > 1e-4)
    assert fine.sum() > 1000
    assert np.percentile(apart[fine] / lengths[fine], 95) < 1.2  # along normals: 5.5 to 6.6


def test_a_trunk_is_thickened_by_the_whole_girth(space):
    moved, weights = moved_by(space, "chest"), space.shaped.body.weights
    trunk = weights[:, [6, 9]].sum(axis=1) > 0.95
    assert np.median(np.linalg.norm(moved[trunk], axis=1)) > 0.9 * THICKER * 0.02

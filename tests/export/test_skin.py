import numpy as np
import pytest

from export.skin import finer_nodes


@pytest.fixture(scope="module")
def skin(tables):
    return tables.skin


def test_stored_weights_are_the_rigs_own(stand_in, skin):
    place = np.argwhere(skin.index > 0)
    points = skin.low + place * skin.step_m
    there = skin.weights[skin.index[tuple(place.T)]]
    np.testing.assert_allclose(there, stand_in.rig.weights_at(points), atol=2e-4)


def test_the_skin_surrounds_the_hull_as_deep_as_one_sees(tables, skin):
    """All eight corners of the cell about anything that may be seen are stored."""
    surfels = tables.surfels
    for share in (0.0, 0.3, 1.0):
        points = surfels.positions - share * surfels.thickness[:, None] * surfels.normals
        cell = np.floor((points - skin.low) / skin.step_m).astype(int)
        stored = [skin.index[tuple((cell + corner).T)] > 0 for corner in np.ndindex(2, 2, 2)]
        assert np.mean(stored) > 0.999  # normals and depths are rounded where they are stored


def test_halving_the_step_changes_no_weight(stand_in, skin):
    nodes = finer_nodes(skin)
    place = np.argwhere(nodes.index > 0)
    rows = nodes.index[tuple(place.T)]
    points = nodes.low + place * nodes.step_m
    np.testing.assert_allclose(nodes.positions[rows], points, atol=1e-6)
    exact = stand_in.rig.weights_at(points)
    np.testing.assert_allclose(nodes.weights[:, rows].T, exact, atol=2e-4)


def test_along_z_rows_follow_each_other(skin):
    index = finer_nodes(skin).index
    both = (index[..., :-1] > 0) & (index[..., 1:] > 0)
    assert (np.diff(index, axis=2)[both] == 1).all()


def test_all_weights_sum_to_one(skin):
    np.testing.assert_allclose(finer_nodes(skin).weights.sum(axis=0), 1.0, atol=1e-5)

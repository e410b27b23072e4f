import numpy as np
import pytest

from baselines.reference_skinning import PosedNodes, skin_trilinear
from capture.input_error import InputError
from export.package.player_tables import RenderSettings, round_codes
from export.player_inputs import skinning_nodes


@pytest.fixture(scope="module")
def skin(tables):
    return tables.skinning


@pytest.mark.parametrize("per_step", [1, 2])
def test_nodes_have_the_rigs_own_weights_whatever_their_step(stand_in, skin, per_step):
    nodes = skinning_nodes(skin, per_step)
    place = np.argwhere(nodes.index > 0)
    rows = nodes.index[tuple(place.T)]
    points = nodes.low + place * nodes.step_m
    np.testing.assert_allclose(nodes.positions[rows], points, atol=1e-6)
    exact = stand_in.rig.weights_at(points)
    np.testing.assert_allclose(nodes.weights[:, rows].T, exact, atol=2e-4)
    both = (nodes.index[..., :-1] > 0) & (nodes.index[..., 1:] > 0)
    assert (np.diff(nodes.index, axis=2)[both] == 1).all()  # along z rows follow each other


def test_the_skinning_grid_surrounds_all_visible_depths(tables, skin):
    """All eight corners of the cell about anything that may be seen are stored."""
    surfels = tables.surfels
    for share in (0.0, 0.3, 1.0):
        points = surfels.positions - share * surfels.thickness[:, None] * surfels.normals
        cell = np.floor((points - skin.low) / skin.step_m).astype(int)
        stored = [skin.index[tuple((cell + corner).T)] > 0 for corner in np.ndindex(2, 2, 2)]
        assert np.mean(stored) > 0.999  # normals and depths are rounded where they are stored


@pytest.mark.parametrize("per_step", [1, 2])
def test_no_inverse_is_taken_of_the_skin_beyond_its_stored_cells(skin, per_step):
    """There the derivative is taken between unrelated nodes, and rays go anywhere: stray dots."""
    nodes, stretch = skinning_nodes(skin, per_step), RenderSettings().max_volume_ratio
    whole, some = np.ones(np.subtract(skin.index.shape, 1), bool), np.zeros(1, bool)
    x, y, z = skin.index.shape
    for i, j, k in np.ndindex(2, 2, 2):
        stored = skin.index[i : x - 1 + i, j : y - 1 + j, k : z - 1 + k] > 0
        whole, some = whole & stored, some | stored

    def trusted(cells):
        inside = np.random.default_rng(0).uniform(0.01, 0.99, (len(cells), 3))
        points = (skin.low + (cells + inside) * skin.step_m).astype(np.float32)
        volume = np.linalg.det(skin_trilinear(PosedNodes(nodes, nodes.positions), points)[1])
        return ((volume > 1 / stretch) & (volume < stretch)).mean()

    assert trusted(np.argwhere(whole)) == 1.0
    assert trusted(np.argwhere(some & ~whole)) == 0.0


def test_stored_normals_point_outward_and_are_nearly_unit(tables):
    normals = tables.surfels.normals
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=0.06)
    codes = tables.surfels.normal_codes
    assert codes.max() <= 127
    assert codes.min() >= -127
    middle = tables.surfels.positions.mean(axis=0)
    outward = ((tables.surfels.positions - middle) * normals).sum(axis=1)
    assert (outward > 0).mean() > 0.6


@pytest.mark.parametrize(("step", "largest"), [(8, 255), (16, 255), (32, 65535), (1, 255)])
def test_rounding_codes_moves_none_by_more_than_a_step(step, largest):
    codes = np.arange(largest + 1).astype(np.uint16 if largest > 255 else np.uint8)
    near = round_codes(codes, step, largest)
    assert near.dtype == codes.dtype
    assert (near % step == 0).all()
    error = np.abs(near.astype(int) - codes.astype(int))
    assert error[: largest - step].max() <= step // 2
    assert error.max() < step


def test_steps_cut_in_other_ways_are_refused(skin):
    with pytest.raises(InputError, match="7 parts"):
        skinning_nodes(skin, 7)

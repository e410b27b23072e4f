from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from export.bake import voxel_cells
from export.bake.compositor import SirtUpdate, VoxelCodes
from export.bake.voxel_cells import (
    brick_chunks,
    choose_cells,
    prune_octrees,
    share_codes,
    share_codes_within_budget,
)

VOXELS = 8**3
"""Voxels of a brick."""


def cost_of(codes, weights, cells, price) -> float:
    """Squared error of the cells' weighted means, and their price."""
    total = 0.0
    for cell in np.unique(cells):
        inside = cells == cell
        mean = (codes[inside] * weights[inside, None]).sum(axis=0) / weights[inside].sum()
        total += (weights[inside, None] * (codes[inside] - mean) ** 2).sum() + price
    return float(total)


def cubes(size):
    """Cells of one size everywhere in a brick."""
    place = np.argwhere(np.ones((8, 8, 8), dtype=bool)) // size * size
    return place @ np.array([64, 8, 1])


@pytest.fixture(scope="module")
def brick():
    """A brick of noise, flat in one half, in which weights fall with depth."""
    generator = np.random.default_rng(0)
    codes = generator.uniform(0.0, 255.0, (8, 8, 8, 3))
    codes[4:] = 100.0
    weights = 10.0 ** -np.arange(8.0)[None, :, None] * np.ones((8, 8, 8))
    return codes.reshape(-1, 3), weights.ravel()


def test_no_cells_of_one_size_are_cheaper(brick):
    codes, weights = brick
    for price in (1e-3, 1.0, 1e3):
        cost = cost_of(codes, weights, prune_octrees(codes, weights, price), price)
        for size in (1, 2, 4, 8):
            assert cost <= cost_of(codes, weights, cubes(size), price) * (1.0 + 1e-6)


def test_cells_are_cubes_that_begin_at_their_first_voxel(brick):
    cells = prune_octrees(*brick, 1.0)
    for cell in np.unique(cells):
        place = np.argwhere((cells == cell).reshape(8, 8, 8))
        edge = round(len(place) ** (1 / 3))
        assert edge in (1, 2, 4, 8)
        assert len(place) == edge**3
        assert np.ptp(place, axis=0).tolist() == [edge - 1] * 3
        assert (place[0] % edge == 0).all()
        assert place[0] @ [64, 8, 1] == cell


def test_what_shows_keeps_its_own_voxels_and_what_is_flat_or_hidden_does_not(brick):
    cells = prune_octrees(*brick, 1.0).reshape(8, 8, 8)
    assert len(np.unique(cells[:4, :2])) == 4 * 2 * 8
    assert len(np.unique(cells[4:])) == 4
    assert len(np.unique(cells[:4, 4:])) < 8


def test_voxels_without_weight_share_one_code_per_brick():
    codes = np.random.default_rng(1).uniform(0.0, 255.0, (2 * VOXELS, 3))
    cells = prune_octrees(codes, np.zeros(2 * VOXELS), 1.0)
    assert np.unique(cells).tolist() == [0, VOXELS]


def test_empty_voxels_do_not_share_codes_with_visible_ones():
    density = np.zeros(VOXELS, dtype=np.float32)
    density[: VOXELS // 2 + 8] = 160.0
    codes = VoxelCodes(density, np.full((VOXELS, 3), 80.0, dtype=np.float32))
    nothing = SirtUpdate.zeros(VOXELS)  # no ray has seen anything
    cells = choose_cells(codes, nothing, density, price=1.0)
    shared = share_codes(codes, nothing, density, cells)
    assert np.array_equal(shared.density > 0, density > 0)
    assert shared.density[density > 0] == pytest.approx(160.0, abs=1e-3)


def test_shared_codes_are_means_weighted_by_what_shows():
    codes = VoxelCodes(
        np.full(VOXELS, 100.0, dtype=np.float32),
        np.repeat(np.float32([[10.0], [50.0]]), VOXELS // 2, axis=0) * np.ones(3, np.float32),
    )
    update = SirtUpdate.zeros(VOXELS)
    update.color_normalizer[: VOXELS // 2] = 3.0
    update.color_normalizer[VOXELS // 2 :] = 1.0
    one = choose_cells(codes, update, codes.density, price=1e9)
    assert not one.color.any()
    shared = share_codes(codes, update, codes.density, one)
    assert shared.color == pytest.approx(np.full((VOXELS, 3), 20.0), rel=1e-3)
    summed = one.sum_update(update)
    assert summed.color_normalizer == pytest.approx(np.full(VOXELS, 2.0 * VOXELS))


@pytest.mark.slow
def test_chunks_do_not_change_shared_codes(tables, monkeypatch):
    given = VoxelCodes.of(tables.bricks)
    generator = np.random.default_rng(4)
    update = SirtUpdate.zeros(len(given.density))
    for sums in update:
        sums += generator.random(sums.shape).astype(np.float32)
    results = []
    for bricks in (1, 7, len(tables.bricks.voxels)):
        monkeypatch.setattr(voxel_cells, "CHUNK_BRICKS", bricks)
        codes = VoxelCodes(given.density.copy(), given.color.copy())
        with ThreadPoolExecutor(2) as executor:
            cells = share_codes_within_budget(
                tables.bricks, codes, update, given.density, 3e3, executor=executor
            )
        assert len(cells) == len(brick_chunks(len(given.density)))
        results.append(codes)
    assert not np.array_equal(results[0].color, given.color)
    for other in results[1:]:
        assert np.array_equal(results[0].color, other.color)
        assert np.array_equal(results[0].density, other.density)

"""Warp cells: points come back from where skinning carried them; samples that a cell invents."""

import math

import numpy as np
import pytest
import torch

from avatar.correspondence_grid import (
    MAX_RAY_DISTANCE_M,
    CorrespondenceCheck,
    CorrespondenceGrid,
    cull_cells,
)
from avatar.kernels import operations
from avatar.kernels.operands import MarchSettings, RayBatch
from avatar.occupancy_grid import OccupancyGrid
from avatar.render import correspondence_tables
from avatar.rig import CLOTHING_BAND_M
from baselines import torch_correspondence, torch_reference


def skinning(rig, rotations):
    """The skinning volume and a pose's bones, as the reference takes them."""
    nodes_per_m = (np.array(rig.weights.shape[:3]) - 1) / (rig.box_high - rig.box_low)
    bones = rig.body_from_canonical(rotations)[:, :3].reshape(24, 12)
    parts = rig.weights, rig.box_low, nodes_per_m, bones
    return tuple(torch.from_numpy(part).float() for part in parts)


def posed(rig, rotations, canonical):
    """Skins canonical points, with the reference."""
    return torch_correspondence.skin_points(torch.from_numpy(canonical), *skinning(rig, rotations))


def nearest_root_error(cells, targets, canonical):
    """How far the nearest of a cell's candidate roots is from where the point came from."""
    return np.linalg.norm(candidates(cells, targets) - canonical[:, None], axis=2).min(axis=1)


def candidates(cells, targets, bends=True):
    """What each root of their cells makes of posed points; far off where there is no such root."""
    place = np.floor((targets - cells.low) / cells.cell_m).astype(int)
    packed = torch.from_numpy(cells.packed_cells[tuple(place.T)])
    offset = torch.from_numpy(targets - (cells.low + (place + 0.5) * cells.cell_m)).float()
    slot, roots = torch.zeros(len(targets), dtype=torch.int64), torch.from_numpy(cells.roots)[None]
    found = []
    for candidate in range(3):
        row = torch_reference.root_row(packed, candidate)
        bent = (packed & 4 > 0) & bends
        point = torch_reference.canonical_points(roots, slot, row, bent, offset)
        found.append(torch.where(row[:, None] > 0, point, 1e3))
    return torch.stack(found, dim=1).numpy()


def solved_roots(cells):
    """Roots and inverse Jacobians, without the rows that say how bent cells bend."""
    packed = torch.from_numpy(cells.packed_cells[cells.packed_cells > 0])
    rows = torch.cat([torch_reference.root_row(packed, candidate) for candidate in range(3)])
    return cells.roots[rows[rows > 0].numpy()]


def around_the_skin(rig, rng, count=20000, spread=0.02):
    seeds = rig.seeds[rng.integers(0, len(rig.seeds), count)]
    return (seeds + rng.normal(size=(count, 3)) * spread).astype(np.float32)


def test_the_canonical_pose_warps_to_itself(rig, rng):
    canonical = around_the_skin(rig, rng)
    cells = CorrespondenceGrid.solve(rig, rig.canonical_rotations)
    error = nearest_root_error(cells, canonical, canonical)
    assert np.quantile(error, 0.999) < 1e-4


def test_points_come_back_from_a_bent_pose_by_a_second_order_term(rig, rng, bent_pose):
    canonical = around_the_skin(rig, rng)
    targets = posed(rig, bent_pose, canonical).numpy()
    cells = CorrespondenceGrid.solve(rig, bent_pose)
    error = nearest_root_error(cells, targets, canonical)
    assert np.median(error) < 1e-4
    assert np.quantile(error, 0.95) < 2e-3
    assert np.mean(error > 1e-2) < 2e-3
    place = np.floor((targets - cells.low) / cells.cell_m).astype(int)
    bent = (cells.packed_cells[tuple(place.T)] & 4) > 0
    assert 0.02 < bent.mean() < 0.4  # the others have none
    straight = candidates(cells, targets[bent], bends=False) - canonical[bent, None]
    straight = np.linalg.norm(straight, axis=2).min(axis=1)
    assert np.median(error[bent]) < 0.4 * np.median(straight)
    assert np.quantile(error[bent], 0.9) < 0.4 * np.quantile(straight, 0.9)


def test_the_inverse_jacobian_undoes_a_small_step(rig, bent_pose, rng):
    cells = CorrespondenceGrid.solve(rig, bent_pose)
    roots = solved_roots(cells)[::29]
    step = rng.normal(size=(len(roots), 3)).astype(np.float32)
    step *= 1e-3 / np.linalg.norm(step, axis=1, keepdims=True)
    moved = posed(rig, bent_pose, roots[:, :3] + step) - posed(rig, bent_pose, roots[:, :3])
    back = np.einsum("nab,nb->na", roots[:, 3:].reshape(-1, 3, 3), moved.numpy())
    off = np.linalg.norm(back - step, axis=1)
    assert np.quantile(off, 0.9) < 1e-4


def test_no_cell_is_far_from_the_body(rig, bent_pose):
    cells = CorrespondenceGrid.solve(rig, bent_pose, band_m=0.05)
    place = (solved_roots(cells)[:, :3] - rig.box_low) / (rig.box_high - rig.box_low)
    cell = (place * rig.skin_distance.shape).astype(int)
    assert rig.skin_distance[tuple(cell.T)].max() <= 0.05 + 0.5 * cells.cell_m


def test_wild_poses_are_solved_without_harm(rig, rng):
    """Far from anything a body does: roots may be lost, but all that is kept is finite."""
    for _ in range(8):
        cells = CorrespondenceGrid.solve(rig, rng.normal(size=(23, 3)) * 2.0)
        assert np.isfinite(cells.roots[1:]).all()
        place = (solved_roots(cells)[:, :3] - rig.box_low) / (rig.box_high - rig.box_low)
        assert ((place >= 0.0) & (place <= 1.0)).all()


def test_nothing_is_read_from_a_node_that_is_not_blended(rig, bent_pose, monkeypatch):
    few = CorrespondenceGrid.solve(rig, bent_pose)
    all_nodes = rig.skinning_nodes_within(9.0)
    monkeypatch.setattr(type(rig), "skinning_nodes_within", lambda self, reach_m: all_nodes)
    everywhere = CorrespondenceGrid.solve(rig, bent_pose)
    np.testing.assert_array_equal(few.packed_cells, everywhere.packed_cells)
    same = np.abs(few.roots - everywhere.roots).max(axis=1) < 1e-3
    assert same.mean() > 0.995  # in folds rounding decides


def test_the_compiled_build_agrees_with_its_meaning(rig, rng, bent_pose):
    band_m = 0.5 * CLOTHING_BAND_M
    ours = CorrespondenceGrid.solve(rig, bent_pose, band_m=band_m)
    bones = rig.body_from_canonical(bent_pose)[:, :3].reshape(24, 12).astype(np.float32)
    low, packed_cells, roots = torch_correspondence.solve_correspondences(
        rig, bones, band_m, ours.cell_m
    )
    theirs = CorrespondenceGrid(low=low, cell_m=ours.cell_m, packed_cells=packed_cells, roots=roots)
    np.testing.assert_allclose(ours.low, theirs.low, atol=1e-5)
    assert ours.packed_cells.shape == theirs.packed_cells.shape
    assert np.mean((ours.packed_cells & 3) == (theirs.packed_cells & 3)) > 0.995
    assert np.mean((ours.packed_cells & 4) == (theirs.packed_cells & 4)) > 0.98
    targets = posed(rig, bent_pose, around_the_skin(rig, rng, spread=0.01)).numpy()
    found = [candidates(cells, targets)[:, :2] for cells in (ours, theirs)]
    gap = np.linalg.norm(found[0][:, :, None] - found[1][:, None], axis=3).min(axis=2)[:, 0]
    assert np.median(gap) < 2e-5
    assert np.quantile(gap, 0.99) < 5e-4
    assert np.mean(gap > 1e-2) < 2e-3


def test_a_wider_band_holds_all_that_a_narrow_one_holds_and_more(rig, rng, bent_pose):
    canonical = around_the_skin(rig, rng, spread=0.06)
    place = (canonical - rig.box_low) / (rig.box_high - rig.box_low) * rig.skin_distance.shape
    inside = ((place >= 0) & (place < rig.skin_distance.shape)).all(axis=1)
    canonical, cell = canonical[inside], place[inside].astype(int)
    off_skin = rig.skin_distance[tuple(cell.T)]
    far = (off_skin > 0.1) & (off_skin < 0.14)
    targets = posed(rig, rig.canonical_rotations + 0.02, canonical).numpy()
    wide = CorrespondenceGrid.solve(rig, rig.canonical_rotations + 0.02, band_m=0.15)
    error = nearest_root_error(wide, targets, canonical)
    assert far.sum() > 1000
    assert np.mean(error[far] < 2e-3) > 0.99


def folded() -> np.ndarray:
    """Elbows bent by 140°, the arms along the body, a knee drawn up."""
    rotations = np.zeros((23, 3))
    rotations[15], rotations[16] = (0.0, 0.0, -1.2), (0.0, 0.0, 1.2)
    rotations[17], rotations[18] = (0.0, -2.4, 0.0), (0.0, 2.4, 0.0)
    rotations[0], rotations[3] = (-1.6, 0.0, 0.1), (2.2, 0.0, 0.0)
    return rotations


@pytest.fixture(scope="module")
def seen(rig):
    """Samples along 4,000 parallel rays through a folded body, and how far off each is carried."""
    rotations, generator = folded(), torch.Generator().manual_seed(0)
    grid = OccupancyGrid(rig).density_grid
    cells = cull_cells(CorrespondenceGrid.solve(rig, rotations), grid)
    low = torch.from_numpy(cells.low)
    size = torch.tensor(cells.packed_cells.shape) * cells.cell_m
    origins = low + size * torch.rand(4000, 3, generator=generator)
    origins[:, 2] = low[2] - 0.1
    count = len(origins)
    along, half = torch.tensor([0.0, 0.0, 1.0]), torch.full((count,), 0.5)
    slots = torch.zeros(count, dtype=torch.int32)
    rays = RayBatch(origins, along.expand(count, 3).contiguous(), slots, half)
    samples, _ = operations.march_resumable(
        rays, correspondence_tables(cells), grid, MarchSettings(0.01, math.inf, 400)
    )
    carried = posed(rig, rotations, samples.points.numpy())
    ray = torch.repeat_interleave(torch.arange(count), samples.counts)
    off = (carried - origins[ray])[:, :2].norm(dim=1)
    strays = CorrespondenceCheck.for_pose(rig, rotations, cells)
    return strays, samples, rays, off


def test_strays_are_samples_that_skinning_carries_elsewhere(seen):
    strays, samples, rays, off = seen
    found = strays.find_spurious(samples, rays)
    assert len(found) > 20
    assert (off[found] > 0.99 * MAX_RAY_DISTANCE_M).all()


def test_nearly_every_sample_that_is_carried_far_is_found(seen):
    """A warp may be right in all corners of its cell and wrong between them, but hardly ever."""
    strays, samples, rays, off = seen
    far = off > 2.0 * MAX_RAY_DISTANCE_M
    found = torch.zeros_like(far)
    found[strays.find_spurious(samples, rays)] = True
    assert (found & far).sum() > 0.98 * far.sum()


def test_few_cells_are_doubtful_and_none_in_the_canonical_pose(rig, seen):
    strays = seen[0]
    assert 0 < strays.unreliable_rows.sum() < 0.2 * len(strays.unreliable_rows)
    canonical = rig.canonical_rotations
    cells = CorrespondenceGrid.solve(rig, canonical)
    assert not CorrespondenceCheck.for_pose(rig, canonical, cells).unreliable_rows.any()

"""Samples that a warp cell invents: found where limbs fold, against skinning in plain torch."""

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
from baselines.torch_correspondence import skin_points


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
    bones = rig.body_from_canonical(rotations)[:, :3].reshape(24, 12)
    nodes = (np.array(rig.weights.shape[:3]) - 1) / (rig.box_high - rig.box_low)
    parts = rig.weights, rig.box_low, nodes.astype(np.float32), bones.astype(np.float32)
    carried = skin_points(samples.points, *(torch.from_numpy(part) for part in parts))
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

"""Samples placed through a posed grid, and roots by Broyden's method."""

import numpy as np
import pytest
import torch

from avatar.config import TrainConfig
from avatar.kernels.operands import RayBatch
from avatar.training.trainer import Trainer
from baselines.instant_avatar.broyden_kernels import find_all_roots
from baselines.instant_avatar.occupied_samples import PosedOccupancy, sample_occupied_cells
from baselines.instant_avatar.posed_field import BroydenWarp

STEP_M = 0.05


def rays_at(boxes, count, generator):
    """Rays from all sides, through the middle of the box of their slot and past it."""
    slots = torch.randint(len(boxes.low), (count,), generator=generator, dtype=torch.int32)
    size = boxes.shape / boxes.cells_per_m
    aim = boxes.low[slots.long()] + size[slots.long()] * torch.rand(count, 3, generator=generator)
    origins = aim + 3.0 * torch.nn.functional.normalize(torch.randn(count, 3, generator=generator))
    directions = torch.nn.functional.normalize(aim - origins)
    return RayBatch(origins, directions, slots, torch.rand(count, generator=generator))


@pytest.fixture
def boxes(generator):
    """Two slots with grids of different shapes, half of their cells occupied.

    Warp cells say with numbers below 0 how far the emptiness reaches: they are empty, too.
    """
    shape = torch.tensor([[5, 7, 3], [4, 4, 4]], dtype=torch.int32)
    low = torch.tensor([[-0.5, -0.8, -0.3], [0.0, 0.1, 0.2]])
    cells_per_m = torch.tensor([[5.0, 4.0, 5.0], [8.0, 4.0, 2.0]])
    return PosedOccupancy(
        occupied=torch.randint(-4, 5, (2, 105), generator=generator, dtype=torch.int32),
        low=low,
        cells_per_m=cells_per_m,
        shape=shape,
        ray_box_low=low,
        ray_box_high=low + shape / cells_per_m,
    )


def test_samples_lie_a_step_apart_and_fill_a_box_that_is_full(boxes, generator):
    full = boxes._replace(occupied=torch.ones_like(boxes.occupied))
    rays = rays_at(full, 100, generator)
    points, counts = sample_occupied_cells(rays, full, STEP_M)
    size = (full.shape / full.cells_per_m)[rays.slots.long()]
    low = full.low[rays.slots.long()]
    near = (low - rays.origins) / rays.directions
    far = (low + size - rays.origins) / rays.directions
    length = torch.maximum(near, far).amin(1) - torch.minimum(near, far).amax(1)
    lattice = torch.ceil(length / STEP_M - rays.jitter)
    assert (counts - lattice).abs().max() <= 1
    ray = torch.repeat_interleave(torch.arange(100), counts)
    apart = (points[1:] - points[:-1]).norm(dim=1)[ray[1:] == ray[:-1]]
    torch.testing.assert_close(apart, torch.full_like(apart, STEP_M), atol=1e-5, rtol=0)


# --- roots ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def posed(rig):
    """Canonical points near the skin, carried to two poses; and the poses, as a warp keeps them."""
    config = TrainConfig(levels=2, table_size=1 << 10)
    avatar = Trainer(rig, config).avatar
    warp = BroydenWarp(avatar.field, rig, 2)
    chance = np.random.default_rng(0)
    cells = np.argwhere(rig.skin_distance < 0.05)
    cells = cells[chance.integers(len(cells), size=600)] + chance.random((600, 3))
    spacing = (rig.box_high - rig.box_low) / rig.skin_distance.shape
    canonical = (cells * spacing + rig.box_low).astype(np.float32)
    slots = np.repeat([0, 1], 300).astype(np.int32)
    carried = np.empty_like(canonical)
    for slot, bend in enumerate((0.0, 0.9)):
        rotations = np.zeros((23, 3))
        rotations[3, 0], rotations[17, 1], rotations[16, 2] = bend, -bend, 0.8
        bones = rig.body_from_canonical(rotations)[:, :3].reshape(24, 12).astype(np.float32)
        warp.set_pose(slot, torch.from_numpy(bones))
        here = slots == slot
        matrix = (rig.weights_at(canonical[here]) @ bones).reshape(-1, 3, 4)
        carried[here] = (matrix[..., :3] @ canonical[here, :, None])[..., 0] + matrix[..., 3]
    return *map(torch.from_numpy, (canonical, carried, slots)), warp.poses


@pytest.mark.slow
def test_broyden_finds_the_point_that_was_carried_there(posed):
    canonical, carried, slots, poses = posed
    roots, valid = find_all_roots(carried, slots, poses)
    off = torch.where(valid, (roots - canonical[:, None]).norm(dim=-1), torch.inf).amin(dim=1)
    assert (off < 1e-3).float().mean() >= 0.99

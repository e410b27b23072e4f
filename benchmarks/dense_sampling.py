"""Samples as they are without skipping: all between the walls of the person's box, or the paper's.

InstantAvatar's code sets near and far to the distance of the body less and plus a metre and puts
its samples there, on every ray of the picture; without skipping each of them is warped and asked.
Here the lattice and the warp are ours: where a sample's cell has no root it is warped with the
nearest cell's, and its density counts as zero. That is a look-up; the paper's own search for roots
would cost a hundred times as much.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Int32
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from avatar.correspondence_grid import CorrespondenceGrid
from avatar.kernels import operations
from avatar.kernels.operands import (
    CorrespondenceTables,
    DensityGrid,
    MarchSettings,
    RayBatch,
    RaySamples,
)
from avatar.render import EMPTY_LOG_DENSITY
from avatar.training.frame_stream import TrainingFrame
from avatar.training.replay_buffer import ReplayBuffer

MAX_DENSE_SAMPLES = 512
REACH_M = 1.0
"""How far before and behind the body's distance the paper's code looks, metres."""


class DenseSampler(NamedTuple):
    """Where all samples of some frames lie.

    Attributes:
        cells: Warps without an empty cell.
        stand_in: First of the roots that stand in for none.
        own: The frames' own cells, which say where a ray's lattice begins.
        center: From here the paper's metre is counted; None for the walls of the cells' box.
    """

    cells: CorrespondenceTables
    first_substitute_row: int
    own: CorrespondenceTables
    center: Float32[Tensor, "3"] | None

    def samples(self, rays: RayBatch, grid: DensityGrid, step_m: float) -> RaySamples:
        """Every sample along rays, none left out and no end before the last."""
        everywhere = grid._replace(occupied=torch.ones_like(grid.occupied))
        if self.center is None:
            how = MarchSettings(step_m, math.inf, MAX_DENSE_SAMPLES)
            return operations.march(rays, self.cells, everywhere, how)
        own, wide = ray_entry(rays, self.own), ray_entry(rays, self.cells)
        near = (rays.origins - self.center).norm(dim=1) - REACH_M
        same_lattice = ((own - wide) / step_m + rays.jitter) % 1.0
        passed = torch.floor((near - wide) / step_m).clamp(min=0.0)
        how = MarchSettings(step_m, math.inf, math.ceil(2.0 * REACH_M / step_m))
        later = rays._replace(jitter=same_lattice + passed)
        return operations.march(later, self.cells, everywhere, how)

    def clear_substitutes(
        self, raw: Float32[Tensor, "samples 4"], rows: Int32[Tensor, "samples"]
    ) -> Float32[Tensor, "samples 4"]:
        """Raw outputs, in place, without density where a sample has no warp of its own."""
        raw[:, 3].masked_fill_(rows >= self.first_substitute_row, EMPTY_LOG_DENSITY)
        return raw


def dense_in_box(cells: CorrespondenceTables, inside: Float32[Tensor, "3"]) -> DenseSampler:
    """Between the walls of each frame's box; a sample without a root is queried at one point."""
    slots, row, _ = cells.roots.shape
    stand_in = torch.zeros(slots, 1, 12)
    stand_in[:, 0, :3] = inside
    index = torch.where(cells.packed_cells <= 0, row * 8 + 1, cells.packed_cells)
    filled = cells._replace(packed_cells=index, roots=torch.cat([cells.roots, stand_in], dim=1))
    return DenseSampler(filled, row, cells, None)


def dense_as_in_paper(
    frames: Sequence[TrainingFrame], center: Float32[np.ndarray, "3"]
) -> tuple[DenseSampler, ReplayBuffer]:
    """A metre before to a metre behind the body, and a store of the frames to draw rays from."""
    ends = np.concatenate([_ends(frame, center) for frame in frames])
    low, high = ends.min(axis=0), ends.max(axis=0)
    most = max(len(frame.correspondences.roots) for frame in frames)
    own, wide = ReplayBuffer(len(frames)), ReplayBuffer(len(frames))
    for frame in frames:
        own.add(frame)
        wide.add(
            dataclasses.replace(
                frame,
                correspondences=extend_correspondences(frame.correspondences, low, high, most),
            )
        )
    middle = torch.from_numpy(center)
    return DenseSampler(wide.correspondences, most, own.correspondences, middle), wide


def _ends(frame: TrainingFrame, center: Float32[np.ndarray, "3"]) -> Float32[np.ndarray, "ends 3"]:
    """Where the samples of a frame's rays begin and end, body frame, metres."""
    middle = np.linalg.norm(frame.origin - center)
    directions = frame.directions()
    ends = [frame.origin + (middle + way) * directions for way in (-REACH_M, REACH_M)]
    return np.concatenate(ends).astype(np.float32)


def extend_correspondences(
    cells: CorrespondenceGrid,
    low: Float32[np.ndarray, "3"],
    high: Float32[np.ndarray, "3"],
    most: int,
) -> CorrespondenceGrid:
    """The cells, filled up and continued to a larger box with the nearest roots there are.

    Args:
        cells: Of a frame.
        low, high: Corners of what must be covered, metres.
        most: From this row on, roots are copies that stand in.
    """
    shape = np.array(cells.packed_cells.shape)
    before = np.ceil((cells.low - low) / cells.cell_m).clip(0).astype(int) + 1
    after = np.ceil((high - cells.low) / cells.cell_m - shape).clip(0).astype(int) + 1
    index = np.pad(cells.packed_cells, np.stack([before, after], axis=1))
    nearest = distance_transform_edt(index <= 0, return_distances=False, return_indices=True)
    copies = ((index >> 3) + most)[tuple(np.asarray(nearest))] * 8 + 1
    roots = np.zeros((most + len(cells.roots), 12), dtype=np.float32)
    roots[: len(cells.roots)] = roots[most:] = cells.roots
    return CorrespondenceGrid(
        low=(cells.low - before * cells.cell_m).astype(np.float32),
        cell_m=cells.cell_m,
        packed_cells=np.where(index <= 0, copies, index).astype(np.int32),
        roots=roots,
    )


def ray_entry(rays: RayBatch, cells: CorrespondenceTables) -> Float32[Tensor, "rays"]:
    """Where rays enter the box of their frame's cells, metres, as marching has it."""
    slot = rays.slots.long()
    towards = torch.where(rays.directions.abs() > 1e-7, rays.directions, 1e-7)
    near = (cells.low[slot] - rays.origins) / towards
    far = near + cells.shape[slot] * cells.cell_m / towards
    return torch.minimum(near, far).amax(dim=1).clamp(min=0.0)

"""The trained field sampled once on a voxel grid, from which everything else is baked."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, UInt8

from avatar.rig import Rig
from export.bake.bake_kernels import dilate_colors
from export.package.player_tables import BRICK_SIZE, LOG_DENSITY_RANGE

FieldFunction = Callable[
    [Float32[torch.Tensor, "points 3"]],
    tuple[Float32[torch.Tensor, "points 3"], Float32[torch.Tensor, "points"]],
]
"""Evaluates color in [0, 1] and density in 1/m at canonical points."""
CHUNK_POINTS = 1 << 18
"""Points per evaluation of the field."""
MIN_DENSITY = float(np.exp(LOG_DENSITY_RANGE[0]))
"""Density below which a node is empty, 1/m."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FieldGrid:
    """Density and color on nodes `low + voxel_m · (i, j, k)`; each count is a multiple of 8, + 1.

    Attributes:
        low: Corner, canonical metres.
        voxel_m: Distance between nodes.
        density: 1/m.
        rgb: 8 bits; empty nodes next to visible ones hold the mean of these.
    """

    low: Float32[np.ndarray, "3"]
    voxel_m: float
    density: Float32[np.ndarray, "x y z"]
    rgb: UInt8[np.ndarray, "x y z 3"]


def sample_field_grid(
    field_at: FieldFunction, rig: Rig, occupied: UInt8[np.ndarray, "cx cy cz"], voxel_m: float
) -> FieldGrid:
    """Sample the field at every node inside an occupied cell; the others are empty.

    Args:
        field_at: The field.
        rig: Its box is what the cells divide.
        occupied: Cells of the box that are not empty, as in `rig.skin_distance`.
        voxel_m: Distance between nodes, metres.
    """
    first, last = _occupied_bounds(occupied)
    cell = (rig.box_high - rig.box_low) / occupied.shape
    low = (rig.box_low + (first - 1) * cell).astype(np.float32)
    extent = (last - first + 3) * cell
    counts = np.ceil(extent / (voxel_m * BRICK_SIZE)).astype(int) * BRICK_SIZE + 1
    density = np.zeros(counts, dtype=np.float32)
    rgb = np.zeros((*counts, 3), dtype=np.uint8)
    for nodes in _occupied_nodes(occupied, (low - rig.box_low) / cell, voxel_m / cell, counts):
        points = torch.from_numpy((low + nodes * voxel_m).astype(np.float32))
        with torch.no_grad():
            colors, densities = field_at(points)
        i, j, k = nodes.T
        place = (i * counts[1] + j) * counts[2] + k
        density.ravel()[place] = densities.numpy()
        rgb.reshape(-1, 3)[place] = np.round(np.clip(colors.numpy(), 0, 1) * 255.0).astype(np.uint8)
    dilate_colors(density > MIN_DENSITY, rgb)
    return FieldGrid(low=low, voxel_m=voxel_m, density=density, rgb=rgb)


def _occupied_bounds(
    occupied: UInt8[np.ndarray, "cx cy cz"],
) -> tuple[Int[np.ndarray, "3"], Int[np.ndarray, "3"]]:
    """Return the first and the last occupied cell along each axis."""
    axes = [np.flatnonzero(occupied.any(axis=tuple({0, 1, 2} - {axis}))) for axis in range(3)]
    return np.array([a[0] for a in axes]), np.array([a[-1] for a in axes])


def _occupied_nodes(
    occupied: UInt8[np.ndarray, "cx cy cz"],
    offset: Float[np.ndarray, "3"],
    step: Float[np.ndarray, "3"],
    counts: Int[np.ndarray, "3"],
) -> Iterator[Int[np.ndarray, "nodes 3"]]:
    """Yield the nodes inside occupied cells, some 10⁵ at a time."""
    padded = np.pad(occupied, 1)
    cells = [
        np.clip(np.floor(offset[k] + np.arange(counts[k]) * step[k]).astype(int) + 1, 0, size - 1)
        for k, size in enumerate(padded.shape)
    ]
    waiting: list[Int[np.ndarray, "nodes 3"]] = []
    for i, cell in enumerate(cells[0]):
        j, k = np.nonzero(padded[cell][np.ix_(cells[1], cells[2])])
        waiting.append(np.stack([np.full_like(j, i), j, k], axis=1))
        if sum(len(nodes) for nodes in waiting) > CHUNK_POINTS or i == counts[0] - 1:
            nodes = np.concatenate(waiting)
            yield from (
                nodes[start : start + CHUNK_POINTS] for start in range(0, len(nodes), CHUNK_POINTS)
            )
            waiting = []

"""Lattice samples along rays in the occupied cells of a body-frame grid, compiled."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Int32, Integer
from numba import prange
from torch import Tensor

from avatar.kernels.kernel_compiler import FAST_MATH, compile_kernel
from avatar.kernels.numba_rendering import nonzero
from avatar.kernels.operands import RayBatch

F32, I32 = np.float32, np.int32


class PosedOccupancy(NamedTuple):
    """Occupied cells in the body frame of each slot.

    Attributes:
        occupied: Above 0 where a cell is occupied.
        low: Corner of each slot's grid, metres.
        cells_per_m: Cells per metre along each axis.
        shape: Cells along each axis.
        ray_box_low, ray_box_high: Corners of the box that bounds the samples of a ray, metres.
    """

    occupied: Integer[Tensor, "slots cells"]
    low: Float32[Tensor, "slots 3"]
    cells_per_m: Float32[Tensor, "slots 3"]
    shape: Int32[Tensor, "slots 3"]
    ray_box_low: Float32[Tensor, "slots 3"]
    ray_box_high: Float32[Tensor, "slots 3"]


def sample_occupied_cells(
    rays: RayBatch, grid: PosedOccupancy, step_m: float
) -> tuple[Float32[Tensor, "samples 3"], Int32[Tensor, "rays"]]:
    """Body-frame samples of rays in a grid's occupied cells, and their number for each ray.

    The compiled kernels walk the lattice twice, to count and to write, since the number of samples
    of a ray is unknown before.
    """
    counts = torch.empty(len(rays.slots), dtype=torch.int32)
    given = (
        *(part.numpy() for part in rays), np.float32(step_m), *(part.numpy() for part in grid)
    )  # fmt: skip
    count_samples_numba(*given, np.empty((0, 3), np.float32), counts.numpy())
    points = torch.empty(int(counts.sum()), 3)
    write_samples_numba(*given, points.numpy(), (torch.cumsum(counts, 0) - counts).numpy())
    return points, counts


@compile_kernel(**FAST_MATH)
def _march_ray_numba(
    origin, towards, jitter, step_m, occupied, low, cells_per_m, shape, near, far, points, first
):
    """Counts one ray's samples, and writes them from row `first` on unless that is negative."""
    enter, leave = F32(0), F32(1e9)
    for axis in range(3):
        direction = nonzero(towards[axis])
        one, other = (near[axis] - origin[axis]) / direction, (far[axis] - origin[axis]) / direction
        enter = max(enter, min(one, other))
        leave = min(leave, max(one, other))
    kept, step = 0, 0
    while True:
        t = enter + (F32(step) + jitter) * step_m
        if t >= leave:
            return kept
        x = origin[0] + t * towards[0]
        y = origin[1] + t * towards[1]
        z = origin[2] + t * towards[2]
        i = min(max(I32((x - low[0]) * cells_per_m[0]), I32(0)), shape[0] - I32(1))
        j = min(max(I32((y - low[1]) * cells_per_m[1]), I32(0)), shape[1] - I32(1))
        k = min(max(I32((z - low[2]) * cells_per_m[2]), I32(0)), shape[2] - I32(1))
        if occupied[(i * shape[1] + j) * shape[2] + k] > 0:
            if first >= 0:
                points[first + kept, 0] = x
                points[first + kept, 1] = y
                points[first + kept, 2] = z
            kept += 1
        step += 1


@compile_kernel(parallel=True, **FAST_MATH)
def count_samples_numba(
    origins,
    directions,
    slots,
    jitter,
    step_m,
    occupied,
    low,
    cells_per_m,
    shape,
    near,
    far,
    nowhere,
    counts,
):
    """Counts the samples of each ray."""
    for ray in prange(origins.shape[0]):
        slot = slots[ray]
        counts[ray] = _march_ray_numba(
            origins[ray], directions[ray], jitter[ray], step_m, occupied[slot], low[slot],
            cells_per_m[slot], shape[slot], near[slot], far[slot], nowhere, -1,
        )  # fmt: skip


@compile_kernel(parallel=True, **FAST_MATH)
def write_samples_numba(
    origins,
    directions,
    slots,
    jitter,
    step_m,
    occupied,
    low,
    cells_per_m,
    shape,
    near,
    far,
    points,
    first,
):
    """Writes the samples of each ray from its first row on."""
    for ray in prange(origins.shape[0]):
        slot = slots[ray]
        _march_ray_numba(
            origins[ray], directions[ray], jitter[ray], step_m, occupied[slot], low[slot],
            cells_per_m[slot], shape[slot], near[slot], far[slot], points, first[ray],
        )  # fmt: skip

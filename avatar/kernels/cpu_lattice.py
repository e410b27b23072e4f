"""RaySamples along rays in the occupied cells of a body frame's grid, compiled for the CPU.

The lattice is walked twice: once to count, once to write, for nobody knows before how many
samples a ray will have.
"""

import numpy as np
from numba import prange

from avatar.kernels.cpu_march import nonzero
from avatar.kernels.jit import FAST_MATH, compile_kernel

F32, I32 = np.float32, np.int32


@compile_kernel(**FAST_MATH)
def _march_ray_numba(
    origin, towards, jitter, step_m, occupied, low, cells_per_m, shape, near, far, points, first
):
    """RaySamples of one ray; they are written from row `first` on, unless it is negative."""
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
    """How many samples each ray has."""
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
    """Writes each ray's samples, from its own row on."""
    for ray in prange(origins.shape[0]):
        slot = slots[ray]
        _march_ray_numba(
            origins[ray], directions[ray], jitter[ray], step_m, occupied[slot], low[slot],
            cells_per_m[slot], shape[slot], near[slot], far[slot], points, first[ray],
        )  # fmt: skip

"""All canonical roots of samples by BroydenLookup's method, as in Fast-SNARF, compiled for the CPU."""

import numpy as np
from numba import prange

from avatar.kernels.cpu_broyden import solve_root
from avatar.kernels.cpu_skin import MATRIX_LANES, transform_point
from avatar.kernels.jit import FAST_MATH, compile_kernel
from avatar.kernels.roots import SAME_ROOT_M

F32 = np.float32
SAMPLES_PER_CHUNK = 256
"""RaySamples that share a thread's buffers."""


@compile_kernel(parallel=True, **FAST_MATH)
def find_all_roots_numba(points, slots, blended, low, nodes_per_m, inverses, roots, valid):
    """Where each search of each sample ends, and whether no earlier one had found that root."""
    count = points.shape[0]
    for chunk in prange((count + SAMPLES_PER_CHUNK - 1) // SAMPLES_PER_CHUNK):
        blend, inverse = np.empty(MATRIX_LANES, np.float32), np.empty(9, np.float32)
        x = np.empty(3, np.float32)
        for i in range(chunk * SAMPLES_PER_CHUNK, min((chunk + 1) * SAMPLES_PER_CHUNK, count)):
            slot = slots[i]
            px, py, pz = points[i, 0], points[i, 1], points[i, 2]
            for start in range(inverses.shape[1]):
                x[0], x[1], x[2] = transform_point(inverses[slot, start], px, py, pz)
                found = solve_root(blended[slot], low, nodes_per_m, points[i], x, blend, inverse, True)
                roots[i, start, 0], roots[i, start, 1], roots[i, start, 2] = x[0], x[1], x[2]
                for other in range(start):
                    dx = roots[i, other, 0] - x[0]
                    dy = roots[i, other, 1] - x[1]
                    dz = roots[i, other, 2] - x[2]
                    if valid[i, other] and dx * dx + dy * dy + dz * dz < F32(SAME_ROOT_M**2):
                        found = False
                valid[i, start] = found

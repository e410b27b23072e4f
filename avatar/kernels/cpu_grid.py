"""Hash-grid encoding and its gradient, compiled for the CPU.

Threads own chunks of points in the forward pass and whole levels in the backward pass, so that no
two write to one place: no atomics, and the same sums for any number of threads.
"""

import numpy as np
from numba import get_num_threads, prange

from avatar.kernels.jit import compile_kernel
from avatar.levels import FEATURES

CHUNK = 256
F32, I32, I64, U32 = np.float32, np.int32, np.int64, np.uint32
FAST = {"fastmath": True, "error_model": "numpy", "nogil": True}


@compile_kernel(inline="always")
def _cell(points, i, low, scale, counts, level):  # noqa: ANN
    x = (points[i, 0] - low[0]) * scale
    y = (points[i, 1] - low[1]) * scale
    z = (points[i, 2] - low[2]) * scale
    ix = min(max(I32(x), I32(0)), counts[level, 0] - I32(2))
    iy = min(max(I32(y), I32(0)), counts[level, 1] - I32(2))
    iz = min(max(I32(z), I32(0)), counts[level, 2] - I32(2))
    return ix, iy, iz, x - ix, y - iy, z - iz


@compile_kernel(inline="always")
def _entry(ix, iy, iz, counts, level, dense, first, mask):
    if dense == 1:
        return first + I64(ix + counts[level, 0] * (iy + counts[level, 1] * iz))
    hashed = U32(ix) ^ (U32(iy) * U32(2654435761)) ^ (U32(iz) * U32(805459861))
    return first + I64(hashed & mask)


@compile_kernel(parallel=True, **FAST)
def encode(points, low, cells_per_m, counts, dense, offsets, table, features):
    """Trilinear features of all levels; points outside the box extrapolate from its border."""
    chunks = (points.shape[0] + CHUNK - 1) // CHUNK
    one = I32(1)
    for chunk in prange(chunks):
        start = chunk * CHUNK
        stop = min(points.shape[0], start + CHUNK)
        for level in range(cells_per_m.shape[0]):
            first = offsets[level]
            mask = U32(offsets[level + 1] - first - 1)
            kind, scale, column = dense[level], cells_per_m[level], level * FEATURES
            for i in range(start, stop):
                ix, iy, iz, x, y, z = _cell(points, i, low, scale, counts, level)
                jx, jy, jz = ix + one, iy + one, iz + one
                e0 = _entry(ix, iy, iz, counts, level, kind, first, mask)
                e1 = _entry(jx, iy, iz, counts, level, kind, first, mask)
                e2 = _entry(ix, jy, iz, counts, level, kind, first, mask)
                e3 = _entry(jx, jy, iz, counts, level, kind, first, mask)
                e4 = _entry(ix, iy, jz, counts, level, kind, first, mask)
                e5 = _entry(jx, iy, jz, counts, level, kind, first, mask)
                e6 = _entry(ix, jy, jz, counts, level, kind, first, mask)
                e7 = _entry(jx, jy, jz, counts, level, kind, first, mask)
                u, v, w = F32(1) - x, F32(1) - y, F32(1) - z
                w0, w1, w2, w3 = u * v * w, x * v * w, u * y * w, x * y * w
                w4, w5, w6, w7 = u * v * z, x * v * z, u * y * z, x * y * z
                for f in range(FEATURES):
                    features[i, column + f] = (
                        w0 * table[e0, f] + w1 * table[e1, f] + w2 * table[e2, f]
                        + w3 * table[e3, f] + w4 * table[e4, f] + w5 * table[e5, f]
                        + w6 * table[e6, f] + w7 * table[e7, f]
                    )  # fmt: skip


@compile_kernel(inline="always")
def _add(grad_table, entry, grad_features, i, column, weight):
    for f in range(FEATURES):
        grad_table[entry, f] += weight * grad_features[i, column + f]


@compile_kernel(parallel=True, **FAST)
def _encode_backward(
    points, low, cells_per_m, counts, dense, offsets, grad_features, grad_table, threads
):
    one = I32(1)
    for thread in prange(threads):
        for level in range(thread, cells_per_m.shape[0], threads):
            first = offsets[level]
            mask = U32(offsets[level + 1] - first - 1)
            kind, scale, column = dense[level], cells_per_m[level], level * FEATURES
            for i in range(points.shape[0]):
                ix, iy, iz, x, y, z = _cell(points, i, low, scale, counts, level)
                jx, jy, jz = ix + one, iy + one, iz + one
                u, v, w = F32(1) - x, F32(1) - y, F32(1) - z
                e0 = _entry(ix, iy, iz, counts, level, kind, first, mask)
                e1 = _entry(jx, iy, iz, counts, level, kind, first, mask)
                e2 = _entry(ix, jy, iz, counts, level, kind, first, mask)
                e3 = _entry(jx, jy, iz, counts, level, kind, first, mask)
                e4 = _entry(ix, iy, jz, counts, level, kind, first, mask)
                e5 = _entry(jx, iy, jz, counts, level, kind, first, mask)
                e6 = _entry(ix, jy, jz, counts, level, kind, first, mask)
                e7 = _entry(jx, jy, jz, counts, level, kind, first, mask)
                _add(grad_table, e0, grad_features, i, column, u * v * w)
                _add(grad_table, e1, grad_features, i, column, x * v * w)
                _add(grad_table, e2, grad_features, i, column, u * y * w)
                _add(grad_table, e3, grad_features, i, column, x * y * w)
                _add(grad_table, e4, grad_features, i, column, u * v * z)
                _add(grad_table, e5, grad_features, i, column, x * v * z)
                _add(grad_table, e6, grad_features, i, column, u * y * z)
                _add(grad_table, e7, grad_features, i, column, x * y * z)


def encode_backward(
    points, low, cells_per_m, counts, dense, offsets, grad_features, grad_table
) -> None:
    """Adds the gradient of `encode` with respect to its table to `grad_table`."""
    _encode_backward(
        points, low, cells_per_m, counts, dense, offsets, grad_features, grad_table,
        get_num_threads(),
    )  # fmt: skip

"""Hash-grid encoding and its gradients, compiled for the CPU.

Threads own chunks of points or, where the table's gradient is summed, whole levels, so that no two
write to one place: no atomics, and the same sums for any number of threads.
"""

import numpy as np
from numba import get_num_threads, prange

from avatar.kernels.jit import FAST, compile_kernel
from avatar.levels import FEATURES

CHUNK = 256
F32, I32, I64, U32 = np.float32, np.int32, np.int64, np.uint32


@compile_kernel(inline="always")
def _entry(ix, iy, iz, counts, level, dense, first, mask):
    if dense == 1:
        return first + I64(ix + counts[level, 0] * (iy + counts[level, 1] * iz))
    hashed = U32(ix) ^ (U32(iy) * U32(2654435761)) ^ (U32(iz) * U32(805459861))
    return first + I64(hashed & mask)


@compile_kernel(inline="always")
def _cell(points, i, low, scale, counts, level, dense, first, mask):
    """Entries of the corners of a point's cell, x fastest, and where in the cell it lies."""
    x = (points[i, 0] - low[0]) * scale
    y = (points[i, 1] - low[1]) * scale
    z = (points[i, 2] - low[2]) * scale
    ix = min(max(I32(x), I32(0)), counts[level, 0] - I32(2))
    iy = min(max(I32(y), I32(0)), counts[level, 1] - I32(2))
    iz = min(max(I32(z), I32(0)), counts[level, 2] - I32(2))
    jx, jy, jz = ix + I32(1), iy + I32(1), iz + I32(1)
    e0 = _entry(ix, iy, iz, counts, level, dense, first, mask)
    e1 = _entry(jx, iy, iz, counts, level, dense, first, mask)
    e2 = _entry(ix, jy, iz, counts, level, dense, first, mask)
    e3 = _entry(jx, jy, iz, counts, level, dense, first, mask)
    e4 = _entry(ix, iy, jz, counts, level, dense, first, mask)
    e5 = _entry(jx, iy, jz, counts, level, dense, first, mask)
    e6 = _entry(ix, jy, jz, counts, level, dense, first, mask)
    e7 = _entry(jx, jy, jz, counts, level, dense, first, mask)
    return e0, e1, e2, e3, e4, e5, e6, e7, x - ix, y - iy, z - iz


@compile_kernel(parallel=True, **FAST)
def encode(points, low, cells_per_m, counts, dense, offsets, table, features):
    """Trilinear features of all levels; points outside the box extrapolate from its border."""
    chunks = (points.shape[0] + CHUNK - 1) // CHUNK
    for chunk in prange(chunks):
        start = chunk * CHUNK
        stop = min(points.shape[0], start + CHUNK)
        for level in range(cells_per_m.shape[0]):
            first = offsets[level]
            mask = U32(offsets[level + 1] - first - 1)
            kind, scale, column = dense[level], cells_per_m[level], level * FEATURES
            for i in range(start, stop):
                e0, e1, e2, e3, e4, e5, e6, e7, x, y, z = _cell(
                    points, i, low, scale, counts, level, kind, first, mask
                )
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
    for thread in prange(threads):
        for level in range(thread, cells_per_m.shape[0], threads):
            first = offsets[level]
            mask = U32(offsets[level + 1] - first - 1)
            kind, scale, column = dense[level], cells_per_m[level], level * FEATURES
            for i in range(points.shape[0]):
                e0, e1, e2, e3, e4, e5, e6, e7, x, y, z = _cell(
                    points, i, low, scale, counts, level, kind, first, mask
                )
                u, v, w = F32(1) - x, F32(1) - y, F32(1) - z
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


@compile_kernel(inline="always")
def _pull(table, entry, grad_features, i, column):
    pull = F32(0)
    for f in range(FEATURES):
        pull += table[entry, f] * grad_features[i, column + f]
    return pull


@compile_kernel(parallel=True, **FAST)
def encode_points_backward(
    points, low, cells_per_m, counts, dense, offsets, table, grad_features, grad_points
):
    """Gradient of `encode` with respect to its points, written to `grad_points`."""
    chunks = (points.shape[0] + CHUNK - 1) // CHUNK
    for chunk in prange(chunks):
        start = chunk * CHUNK
        stop = min(points.shape[0], start + CHUNK)
        for i in range(start, stop):
            grad_points[i, 0] = grad_points[i, 1] = grad_points[i, 2] = F32(0)
        for level in range(cells_per_m.shape[0]):
            first = offsets[level]
            mask = U32(offsets[level + 1] - first - 1)
            kind, scale, column = dense[level], cells_per_m[level], level * FEATURES
            for i in range(start, stop):
                e0, e1, e2, e3, e4, e5, e6, e7, x, y, z = _cell(
                    points, i, low, scale, counts, level, kind, first, mask
                )
                p0 = _pull(table, e0, grad_features, i, column)
                p1 = _pull(table, e1, grad_features, i, column)
                p2 = _pull(table, e2, grad_features, i, column)
                p3 = _pull(table, e3, grad_features, i, column)
                p4 = _pull(table, e4, grad_features, i, column)
                p5 = _pull(table, e5, grad_features, i, column)
                p6 = _pull(table, e6, grad_features, i, column)
                p7 = _pull(table, e7, grad_features, i, column)
                u, v, w = F32(1) - x, F32(1) - y, F32(1) - z
                grad_points[i, 0] += scale * (
                    v * w * (p1 - p0) + y * w * (p3 - p2) + v * z * (p5 - p4) + y * z * (p7 - p6)
                )
                grad_points[i, 1] += scale * (
                    u * w * (p2 - p0) + x * w * (p3 - p1) + u * z * (p6 - p4) + x * z * (p7 - p5)
                )
                grad_points[i, 2] += scale * (
                    u * v * (p4 - p0) + x * v * (p5 - p1) + u * y * (p6 - p2) + x * y * (p7 - p3)
                )

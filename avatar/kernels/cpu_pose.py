"""What a pose's gradient needs, compiled for the CPU: from samples back to joints.

A sample's canonical point is x = warp(p; θ) with LBS(x; θ) = p. Where the loss pulls x with g_x, it
pulls the posed point with g = J⁻ᵀ g_x, and by the implicit function theorem the pose feels
-(∂LBS/∂θ)ᵀ g. A bone of weight w turns its share of the body rigidly, so that all of it is carried
by one wrench a bone: the force Σ w g and the moment Σ w (B x) × g.
"""

import numpy as np
from numba import prange

from avatar.kernels.jit import compile_kernel
from avatar.levels import FEATURES

F32, I32, I64, U32 = np.float32, np.int32, np.int64, np.uint32
FAST = {"fastmath": True, "error_model": "numpy", "nogil": True}
CHUNK = 256
LONGEST_STEP_M = 0.05
"""A root never moves farther than this at once: where the chord is longer the warp has a fold."""


@compile_kernel(inline="always")
def _pull(table, entry, grad_features, i, column):
    pull = F32(0)
    for f in range(FEATURES):
        pull += table[entry, f] * grad_features[i, column + f]
    return pull


@compile_kernel(inline="always")
def _entry(ix, iy, iz, counts, level, dense, first, mask):
    if dense == 1:
        return first + I64(ix + counts[level, 0] * (iy + counts[level, 1] * iz))
    hashed = U32(ix) ^ (U32(iy) * U32(2654435761)) ^ (U32(iz) * U32(805459861))
    return first + I64(hashed & mask)


@compile_kernel(parallel=True, **FAST)
def encode_points_backward(
    points, low, cells_per_m, counts, dense, offsets, table, grad_features, grad_points
):
    """Gradient of the hash-grid features with respect to the points."""
    chunks = (points.shape[0] + CHUNK - 1) // CHUNK
    one = I32(1)
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
                x = (points[i, 0] - low[0]) * scale
                y = (points[i, 1] - low[1]) * scale
                z = (points[i, 2] - low[2]) * scale
                ix = min(max(I32(x), I32(0)), counts[level, 0] - I32(2))
                iy = min(max(I32(y), I32(0)), counts[level, 1] - I32(2))
                iz = min(max(I32(z), I32(0)), counts[level, 2] - I32(2))
                x, y, z = x - ix, y - iy, z - iz
                jx, jy, jz = ix + one, iy + one, iz + one
                e0 = _entry(ix, iy, iz, counts, level, kind, first, mask)
                e1 = _entry(jx, iy, iz, counts, level, kind, first, mask)
                e2 = _entry(ix, jy, iz, counts, level, kind, first, mask)
                e3 = _entry(jx, jy, iz, counts, level, kind, first, mask)
                e4 = _entry(ix, iy, jz, counts, level, kind, first, mask)
                e5 = _entry(jx, iy, jz, counts, level, kind, first, mask)
                e6 = _entry(ix, jy, jz, counts, level, kind, first, mask)
                e7 = _entry(jx, jy, jz, counts, level, kind, first, mask)
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


@compile_kernel(**FAST)
def _weights_at(weights, low, nodes_per_m, x, y, z, out):
    """Trilinear skinning weights of all joints at a canonical point."""
    a = min(max((x - low[0]) * nodes_per_m[0], F32(0)), F32(weights.shape[0] - 1.001))
    b = min(max((y - low[1]) * nodes_per_m[1], F32(0)), F32(weights.shape[1] - 1.001))
    c = min(max((z - low[2]) * nodes_per_m[2], F32(0)), F32(weights.shape[2] - 1.001))
    i, j, k = I32(a), I32(b), I32(c)
    a, b, c = a - i, b - j, c - k
    u, v, w = F32(1) - a, F32(1) - b, F32(1) - c
    w0, w1, w2, w3 = u * v * w, u * v * c, u * b * w, u * b * c
    w4, w5, w6, w7 = a * v * w, a * v * c, a * b * w, a * b * c
    for q in range(24):
        out[q] = (
            w0 * weights[i, j, k, q] + w1 * weights[i, j, k + 1, q]
            + w2 * weights[i, j + 1, k, q] + w3 * weights[i, j + 1, k + 1, q]
            + w4 * weights[i + 1, j, k, q] + w5 * weights[i + 1, j, k + 1, q]
            + w6 * weights[i + 1, j + 1, k, q] + w7 * weights[i + 1, j + 1, k + 1, q]
        )  # fmt: skip


@compile_kernel(**FAST)
def add_wrenches(
    points, grad_points, rows, first, count, slots, cell_roots,
    weights, low, nodes_per_m, bones, wrenches,
):  # fmt: skip
    """Adds every sample's pull to the wrenches of the bones that move it.

    Args:
        points, grad_points: Canonical samples and what pulls them.
        rows: Root of `cell_roots[slot]` that each sample was warped with.
        first, count, slots: Each ray's samples and its frame's slot.
        cell_roots: Roots and inverse Jacobians (slots, roots, 12).
        weights, low, nodes_per_m: The skinning volume.
        bones: Body-from-canonical matrices (slots, 24, 12).
        wrenches: (slots, 24, 6), force then moment about the body frame's origin.
    """
    share = np.empty(24, np.float32)
    for ray in range(first.shape[0]):
        slot = slots[ray]
        for i in range(first[ray], first[ray] + count[ray]):
            inverse = cell_roots[slot, rows[i]]
            a, b, c = grad_points[i, 0], grad_points[i, 1], grad_points[i, 2]
            fx = inverse[3] * a + inverse[6] * b + inverse[9] * c
            fy = inverse[4] * a + inverse[7] * b + inverse[10] * c
            fz = inverse[5] * a + inverse[8] * b + inverse[11] * c
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            _weights_at(weights, low, nodes_per_m, x, y, z, share)
            for joint in range(24):
                w = share[joint]
                if w < F32(1e-3):
                    continue
                m, out = bones[slot, joint], wrenches[slot, joint]
                px = m[0] * x + m[1] * y + m[2] * z + m[3]
                py = m[4] * x + m[5] * y + m[6] * z + m[7]
                pz = m[8] * x + m[9] * y + m[10] * z + m[11]
                out[0] += w * fx
                out[1] += w * fy
                out[2] += w * fz
                out[3] += w * (py * fz - pz * fy)
                out[4] += w * (pz * fx - px * fz)
                out[5] += w * (px * fy - py * fx)


@compile_kernel(**FAST)
def _skinned(weights, low, nodes_per_m, bones, x, y, z, share, blend):
    _weights_at(weights, low, nodes_per_m, x, y, z, share)
    for q in range(12):
        blend[q] = F32(0)
    for joint in range(24):
        if share[joint] > F32(0):
            for q in range(12):
                blend[q] += share[joint] * bones[joint, q]
    return (
        blend[0] * x + blend[1] * y + blend[2] * z + blend[3],
        blend[4] * x + blend[5] * y + blend[6] * z + blend[7],
        blend[8] * x + blend[9] * y + blend[10] * z + blend[11],
    )


@compile_kernel(parallel=True, **FAST)
def follow(index, shape, grid_low, cell_m, roots, weights, low, nodes_per_m, bones):
    """Moves a frame's roots after its pose: one chord step each, towards the cell's centre.

    Args:
        index: The frame's cells, flat.
        shape, grid_low, cell_m: Their grid.
        roots: Roots, updated in place, and inverse Jacobians, which stay.
        weights, low, nodes_per_m: The skinning volume.
        bones: The new pose's matrices (24, 12).
    """
    for i in prange(shape[0]):
        share, blend = np.empty(24, np.float32), np.empty(12, np.float32)
        for j in range(shape[1]):
            for k in range(shape[2]):
                packed = index[(i * shape[1] + j) * shape[2] + k]
                for row in range(packed >> 2, (packed >> 2) + (packed & 3)):
                    r = roots[row]
                    sx, sy, sz = _skinned(
                        weights, low, nodes_per_m, bones, r[0], r[1], r[2], share, blend
                    )
                    ex = grid_low[0] + (F32(i) + F32(0.5)) * cell_m - sx
                    ey = grid_low[1] + (F32(j) + F32(0.5)) * cell_m - sy
                    ez = grid_low[2] + (F32(k) + F32(0.5)) * cell_m - sz
                    dx = r[3] * ex + r[4] * ey + r[5] * ez
                    dy = r[6] * ex + r[7] * ey + r[8] * ez
                    dz = r[9] * ex + r[10] * ey + r[11] * ez
                    length = np.sqrt(dx * dx + dy * dy + dz * dz)
                    if length > F32(LONGEST_STEP_M):
                        continue
                    r[0] += dx
                    r[1] += dy
                    r[2] += dz

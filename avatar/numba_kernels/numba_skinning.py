"""Linear blend skinning at one point, compiled for the CPU.

What a pose's gradient needs, compiled for the CPU: from samples back to joints.

A sample's canonical point is x = warp(p; θ) with LBS(x; θ) = p. Where the loss pulls x with g_x, it
pulls the posed point with g = J⁻ᵀ g_x, and by the implicit function theorem the pose feels
-(∂LBS/∂θ)ᵀ g. A bone of weight w turns its share of the body rigidly, so that all of it is carried
by one wrench a bone: the force Σ w g and the moment Σ w (B x) × g.
"""

import numpy as np
from numba import prange

from avatar.kernels.torch_skinning import MAX_ROOT_STEP_M
from avatar.numba_kernels.kernel_compiler import FAST_MATH, NO_ALLOCATION, compile_kernel

F32, U32 = np.float32, np.uint32
MATRIX_LANES = 16
"""Floats that a 3×4 matrix takes in a volume of transforms: as many as a register and a cache line
hold. The last four are nothing."""


@compile_kernel(inline="always", **FAST_MATH)
def interpolate_at(volume, low, nodes_per_m, x, y, z, channels, out):
    """Trilinear values of a volume (x, y, z, channels) at a point; the border's outside."""
    a = min(max((x - low[0]) * nodes_per_m[0], F32(0)), F32(volume.shape[0] - 1.001))
    b = min(max((y - low[1]) * nodes_per_m[1], F32(0)), F32(volume.shape[1] - 1.001))
    c = min(max((z - low[2]) * nodes_per_m[2], F32(0)), F32(volume.shape[2] - 1.001))
    i, j, k = U32(a), U32(b), U32(c)  # unsigned: spares the check for negative indices
    i1, j1, k1 = i + U32(1), j + U32(1), k + U32(1)
    a, b, c = a - F32(i), b - F32(j), c - F32(k)
    u, v, w = F32(1) - a, F32(1) - b, F32(1) - c
    w0, w1, w2, w3 = u * v * w, u * v * c, u * b * w, u * b * c
    w4, w5, w6, w7 = a * v * w, a * v * c, a * b * w, a * b * c
    for q in range(channels):
        out[q] = (
            w0 * volume[i, j, k, q] + w1 * volume[i, j, k1, q]
            + w2 * volume[i, j1, k, q] + w3 * volume[i, j1, k1, q]
            + w4 * volume[i1, j, k, q] + w5 * volume[i1, j, k1, q]
            + w6 * volume[i1, j1, k, q] + w7 * volume[i1, j1, k1, q]
        )  # fmt: skip


@compile_kernel(inline="always", **FAST_MATH)
def transform_point(m, x, y, z):
    """A point moved by a row-major 3×4 matrix."""
    return (
        m[0] * x + m[1] * y + m[2] * z + m[3],
        m[4] * x + m[5] * y + m[6] * z + m[7],
        m[8] * x + m[9] * y + m[10] * z + m[11],
    )


@compile_kernel(**NO_ALLOCATION)
def blend_nodes(nodes, first, joints, shares, bones, transforms):
    """Blends the bones' matrices at some nodes of a volume (flat, `LANES`), in place.

    Args:
        nodes: Which nodes.
        first, joints, shares: The bones that move each, and how much: those of node n stand from
            `first[n]` to `first[n + 1]`.
        bones: (24, `LANES`).
        transforms: (nodes of the volume, `LANES`); only the named ones are written.
    """
    for n in range(nodes.shape[0]):
        node = nodes[n]
        for q in range(MATRIX_LANES):
            transforms[node, q] = shares[first[n]] * bones[joints[first[n]], q]
        for e in range(first[n] + 1, first[n + 1]):
            joint, share = joints[e], shares[e]
            for q in range(MATRIX_LANES):
                transforms[node, q] += share * bones[joint, q]


F32, I32 = np.float32, np.int32


@compile_kernel(**FAST_MATH)
def _weights_at(weights, low, nodes_per_m, x, y, z, out):
    interpolate_at(weights, low, nodes_per_m, x, y, z, 24, out)


@compile_kernel(parallel=True, **FAST_MATH)
def bone_wrenches(
    points, grad_points, rows, first, count, slots, cell_roots,
    weights, low, nodes_per_m, bones, out,
):  # fmt: skip
    """Adds up what each ray's samples exert on the bones that move them.

    Args:
        points, grad_points: Canonical samples and what pulls them.
        rows: Root of `cell_roots[slot]` that each sample was warped with.
        first, count, slots: Each ray's samples and its frame's slot.
        cell_roots: Roots and inverse Jacobians (slots, roots, 12).
        weights, low, nodes_per_m: The skinning volume.
        bones: Body-from-canonical matrices (slots, 24, 12).
        out: (rays, 24, 6), zero before: force then moment about the body frame's origin.
    """
    for ray in prange(first.shape[0]):
        share = np.empty(24, np.float32)
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
                m, felt = bones[slot, joint], out[ray, joint]
                px, py, pz = transform_point(m, x, y, z)
                felt[0] += w * fx
                felt[1] += w * fy
                felt[2] += w * fz
                felt[3] += w * (py * fz - pz * fy)
                felt[4] += w * (pz * fx - px * fz)
                felt[5] += w * (px * fy - py * fx)


@compile_kernel(**FAST_MATH)
def _skin_point(weights, low, nodes_per_m, bones, x, y, z, share, blend):
    _weights_at(weights, low, nodes_per_m, x, y, z, share)
    for q in range(12):
        blend[q] = F32(0)
    for joint in range(24):
        if share[joint] > F32(0):
            for q in range(12):
                blend[q] += share[joint] * bones[joint, q]
    return transform_point(blend, x, y, z)


@compile_kernel(parallel=True, **FAST_MATH)
def update_roots(packed_cells, shape, grid_low, cell_m, roots, weights, low, nodes_per_m, bones):
    """Moves a frame's roots to follow its pose, by one chord step towards the cell's center.

    Args:
        packed_cells: Packed cells of the frame, flat.
        shape, grid_low, cell_m: Shape, corner and cell size of their grid.
        roots: Roots, updated in place; inverse Jacobians and second-order terms stay.
        weights, low, nodes_per_m: The skinning volume.
        bones: The new pose's matrices (24, 12).
    """
    for i in prange(shape[0]):
        share, blend = np.empty(24, np.float32), np.empty(12, np.float32)
        for j in range(shape[1]):
            for k in range(shape[2]):
                packed = packed_cells[(i * shape[1] + j) * shape[2] + k]
                rows = 3 if packed & 4 else 1
                for candidate in range(packed & 3):
                    r = roots[(packed >> 3) + candidate * rows]
                    sx, sy, sz = _skin_point(
                        weights, low, nodes_per_m, bones, r[0], r[1], r[2], share, blend
                    )
                    ex = grid_low[0] + (F32(i) + F32(0.5)) * cell_m - sx
                    ey = grid_low[1] + (F32(j) + F32(0.5)) * cell_m - sy
                    ez = grid_low[2] + (F32(k) + F32(0.5)) * cell_m - sz
                    dx = r[3] * ex + r[4] * ey + r[5] * ez
                    dy = r[6] * ex + r[7] * ey + r[8] * ez
                    dz = r[9] * ex + r[10] * ey + r[11] * ez
                    length = np.sqrt(dx * dx + dy * dy + dz * dz)
                    if length > F32(MAX_ROOT_STEP_M):
                        continue
                    r[0] += dx
                    r[1] += dy
                    r[2] += dz

"""Linear blend skinning at one point, compiled for the CPU."""

import numpy as np

from avatar.kernels.jit import FAST_MATH, NO_ALLOCATION, compile_kernel

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
    i, j, k = U32(a), U32(b), U32(c)  # unsigned: no index is asked whether it counts from the end
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

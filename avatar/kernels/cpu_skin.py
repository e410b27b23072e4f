"""Linear blend skinning at one point, compiled for the CPU."""

import numpy as np

from avatar.kernels.jit import FAST, compile_kernel

F32, I32 = np.float32, np.int32


@compile_kernel(inline="always", **FAST)
def interpolate(volume, low, nodes_per_m, x, y, z, channels, out):
    """Trilinear values of a volume (x, y, z, channels) at a point; the border's outside."""
    a = min(max((x - low[0]) * nodes_per_m[0], F32(0)), F32(volume.shape[0] - 1.001))
    b = min(max((y - low[1]) * nodes_per_m[1], F32(0)), F32(volume.shape[1] - 1.001))
    c = min(max((z - low[2]) * nodes_per_m[2], F32(0)), F32(volume.shape[2] - 1.001))
    i, j, k = I32(a), I32(b), I32(c)
    a, b, c = a - i, b - j, c - k
    u, v, w = F32(1) - a, F32(1) - b, F32(1) - c
    w0, w1, w2, w3 = u * v * w, u * v * c, u * b * w, u * b * c
    w4, w5, w6, w7 = a * v * w, a * v * c, a * b * w, a * b * c
    for q in range(channels):
        out[q] = (
            w0 * volume[i, j, k, q] + w1 * volume[i, j, k + 1, q]
            + w2 * volume[i, j + 1, k, q] + w3 * volume[i, j + 1, k + 1, q]
            + w4 * volume[i + 1, j, k, q] + w5 * volume[i + 1, j, k + 1, q]
            + w6 * volume[i + 1, j + 1, k, q] + w7 * volume[i + 1, j + 1, k + 1, q]
        )  # fmt: skip


@compile_kernel(inline="always", **FAST)
def moved(m, x, y, z):
    """A point moved by a row-major 3×4 matrix."""
    return (
        m[0] * x + m[1] * y + m[2] * z + m[3],
        m[4] * x + m[5] * y + m[6] * z + m[7],
        m[8] * x + m[9] * y + m[10] * z + m[11],
    )

"""What a pose's gradient needs, compiled for the CPU: from samples back to joints.

A sample's canonical point is x = warp(p; θ) with LBS(x; θ) = p. Where the loss pulls x with g_x, it
pulls the posed point with g = J⁻ᵀ g_x, and by the implicit function theorem the pose feels
-(∂LBS/∂θ)ᵀ g. A bone of weight w turns its share of the body rigidly, so that all of it is carried
by one wrench a bone: the force Σ w g and the moment Σ w (B x) × g.
"""

import numpy as np
from numba import prange

from avatar.kernels.cpu_skin import interpolate_at, transform_point
from avatar.kernels.jit import FAST_MATH, compile_kernel
from avatar.kernels.pose import MAX_ROOT_STEP_M

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
    """Moves a frame's roots after its pose: one chord step each, towards the cell's centre.

    Args:
        index: The frame's cells, flat.
        shape, grid_low, cell_m: Their grid.
        roots: Roots, updated in place; inverse Jacobians and bends, which stay.
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

"""Fast-SNARF roots at the centres of a frame's warp cells, compiled for the CPU.

Serial and without the interpreter's lock: the ingest thread runs it beside the trainer.
"""

import math

import numpy as np

from avatar.kernels.cpu_skin import interpolate, moved
from avatar.kernels.jit import FAST, compile_kernel

F32, I32, I64 = np.float32, np.int32, np.int64
STARTS = 4
"""Body parts tried per cell, nearest first."""
ROOTS = 3
"""Roots kept per cell; two bits hold their number."""
SAME_ROOT_M = 0.02
TOLERANCE_M = 1e-4
ITERATIONS = 12
LONGEST_STEP_M = 0.3
PROBE_M = 5e-3
"""Half the base of the central differences that give the Jacobian."""


@compile_kernel(inline="always", **FAST)
def _inverse(m, out):
    """Inverse of the 3×3 part of a row-major 3×4 matrix."""
    a, b, c, d, e, f, g, h, i = m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]
    p, q, r = e * i - f * h, f * g - d * i, d * h - e * g
    det = a * p + b * q + c * r
    s = F32(1) / (det if abs(det) > F32(1e-6) else F32(1e-6))
    out[0], out[1], out[2] = p * s, (c * h - b * i) * s, (b * f - c * e) * s
    out[3], out[4], out[5] = q * s, (a * i - c * g) * s, (c * d - a * f) * s
    out[6], out[7], out[8] = r * s, (b * g - a * h) * s, (a * e - b * d) * s


@compile_kernel(**FAST)
def _solve(transforms, low, nodes_per_m, px, py, pz, x, blend, inverse):
    """Broyden's method (good update) for LBS(x) = p, from x; True if it came to rest."""
    interpolate(transforms, low, nodes_per_m, x[0], x[1], x[2], 12, blend)
    _inverse(blend, inverse)
    sx, sy, sz = moved(blend, x[0], x[1], x[2])
    fx, fy, fz = sx - px, sy - py, sz - pz
    for _ in range(ITERATIONS):
        size = fx * fx + fy * fy + fz * fz
        if size <= F32(TOLERANCE_M * TOLERANCE_M):
            return True
        if size > F32(1):
            return False
        dx = -(inverse[0] * fx + inverse[1] * fy + inverse[2] * fz)
        dy = -(inverse[3] * fx + inverse[4] * fy + inverse[5] * fz)
        dz = -(inverse[6] * fx + inverse[7] * fy + inverse[8] * fz)
        if dx * dx + dy * dy + dz * dz > F32(LONGEST_STEP_M * LONGEST_STEP_M):
            return False  # off the volume, or in a fold: nothing that follows would be sound
        x[0] += dx
        x[1] += dy
        x[2] += dz
        interpolate(transforms, low, nodes_per_m, x[0], x[1], x[2], 12, blend)
        sx, sy, sz = moved(blend, x[0], x[1], x[2])
        gx, gy, gz = sx - px, sy - py, sz - pz
        yx, yy, yz = gx - fx, gy - fy, gz - fz
        jx = inverse[0] * yx + inverse[1] * yy + inverse[2] * yz
        jy = inverse[3] * yx + inverse[4] * yy + inverse[5] * yz
        jz = inverse[6] * yx + inverse[7] * yy + inverse[8] * yz
        den = dx * jx + dy * jy + dz * jz
        den = den if abs(den) > F32(1e-12) else F32(1e-12)
        rx = dx * inverse[0] + dy * inverse[3] + dz * inverse[6]
        ry = dx * inverse[1] + dy * inverse[4] + dz * inverse[7]
        rz = dx * inverse[2] + dy * inverse[5] + dz * inverse[8]
        ux, uy, uz = (dx - jx) / den, (dy - jy) / den, (dz - jz) / den
        inverse[0] += ux * rx
        inverse[1] += ux * ry
        inverse[2] += ux * rz
        inverse[3] += uy * rx
        inverse[4] += uy * ry
        inverse[5] += uy * rz
        inverse[6] += uz * rx
        inverse[7] += uz * ry
        inverse[8] += uz * rz
        fx, fy, fz = gx, gy, gz
    return fx * fx + fy * fy + fz * fz <= F32(4 * TOLERANCE_M * TOLERANCE_M)


@compile_kernel(**FAST)
def _jacobian_inverse(transforms, low, nodes_per_m, x, blend, jacobian, out):
    """Inverse of dLBS/dx at x by central differences, weight gradients included."""
    for axis in range(3):
        hx = F32(PROBE_M) if axis == 0 else F32(0)
        hy = F32(PROBE_M) if axis == 1 else F32(0)
        hz = F32(PROBE_M) if axis == 2 else F32(0)
        interpolate(transforms, low, nodes_per_m, x[0] + hx, x[1] + hy, x[2] + hz, 12, blend)
        ax, ay, az = moved(blend, x[0] + hx, x[1] + hy, x[2] + hz)
        interpolate(transforms, low, nodes_per_m, x[0] - hx, x[1] - hy, x[2] - hz, 12, blend)
        bx, by, bz = moved(blend, x[0] - hx, x[1] - hy, x[2] - hz)
        jacobian[axis] = (ax - bx) / F32(2 * PROBE_M)
        jacobian[4 + axis] = (ay - by) / F32(2 * PROBE_M)
        jacobian[8 + axis] = (az - bz) / F32(2 * PROBE_M)
    _inverse(jacobian, out)


@compile_kernel(**FAST)
def _nearest_seeds(seeds, parts, center_x, grid_low, cell_m, reach_m, distance, nearest):
    """The nearest seed of each of the `STARTS` nearest body parts, for one slab of cells."""
    ny, nz = nearest.shape[0], nearest.shape[1]
    for s in range(seeds.shape[0]):
        dx = seeds[s, 0] - center_x
        if abs(dx) >= reach_m:
            continue
        radius = math.sqrt(reach_m * reach_m - dx * dx)
        j0 = max(0, int(math.ceil((seeds[s, 1] - radius - grid_low[1]) / cell_m - 0.5)))
        j1 = min(ny - 1, int(math.floor((seeds[s, 1] + radius - grid_low[1]) / cell_m - 0.5)))
        k0 = max(0, int(math.ceil((seeds[s, 2] - radius - grid_low[2]) / cell_m - 0.5)))
        k1 = min(nz - 1, int(math.floor((seeds[s, 2] + radius - grid_low[2]) / cell_m - 0.5)))
        for j in range(j0, j1 + 1):
            dy = seeds[s, 1] - (grid_low[1] + (j + F32(0.5)) * cell_m)
            for k in range(k0, k1 + 1):
                dz = seeds[s, 2] - (grid_low[2] + (k + F32(0.5)) * cell_m)
                d = dx * dx + dy * dy + dz * dz
                place = STARTS - 1
                for q in range(STARTS):
                    held = nearest[j, k, q]
                    if held < 0 or parts[held] == parts[s]:
                        place = q
                        break
                if d >= distance[j, k, place]:
                    continue
                while place > 0 and d < distance[j, k, place - 1]:
                    distance[j, k, place] = distance[j, k, place - 1]
                    nearest[j, k, place] = nearest[j, k, place - 1]
                    place -= 1
                distance[j, k, place] = d
                nearest[j, k, place] = s


@compile_kernel(**FAST)
def _in_band(x, low, cells_per_m, distance, band_m):
    a = I32(math.floor((x[0] - low[0]) * cells_per_m[0]))
    b = I32(math.floor((x[1] - low[1]) * cells_per_m[1]))
    c = I32(math.floor((x[2] - low[2]) * cells_per_m[2]))
    if a < 0 or b < 0 or c < 0:
        return False
    if a >= distance.shape[0] or b >= distance.shape[1] or c >= distance.shape[2]:
        return False
    return distance[a, b, c] <= band_m


@compile_kernel(**FAST)
def build_cells(
    transforms, low, nodes_per_m, seeds, seed_inverses, parts, grid_low, cell_m, reach_m,
    distance, cells_per_m, band_m, index, roots,
):  # fmt: skip
    """Fills `index` and `roots` of one frame; returns how many roots there are.

    Args:
        transforms: Blended 3×4 transforms on the weight volume's nodes (x, y, z, 12); zero on
            nodes too far from the skin to matter.
        low, nodes_per_m: Place and scale of those nodes.
        seeds, seed_inverses, parts: Posed seeds, their inverse transforms, their body parts.
        grid_low, cell_m: Corner of the frame's grid and its cell size, body frame.
        reach_m: Seeds farther than this from a cell's centre start no root finding.
        distance, cells_per_m, band_m: Roots farther from the canonical skin are dropped.
        index: (gx, gy, gz), `first_root * 4 + count`, 0 where there is none; written whole.
        roots: (capacity, 12): root and inverse Jacobian at the cell's centre. A returned number
            above the capacity means that nothing beyond it was written.
    """
    nx, ny, nz = index.shape
    blend, jacobian = np.empty(12, np.float32), np.empty(12, np.float32)
    inverse, x = np.empty(9, np.float32), np.empty(3, np.float32)
    near_m = np.empty((ny, nz, STARTS), np.float32)
    nearest = np.empty((ny, nz, STARTS), np.int32)
    total = 1  # entry 0 stays unused, so that no packed index is 0
    for i in range(nx):
        near_m[:] = reach_m * reach_m
        nearest[:] = -1
        px = grid_low[0] + (i + F32(0.5)) * cell_m
        _nearest_seeds(seeds, parts, px, grid_low, cell_m, reach_m, near_m, nearest)
        for j in range(ny):
            for k in range(nz):
                index[i, j, k] = 0
                found = 0
                py = grid_low[1] + (j + F32(0.5)) * cell_m
                pz = grid_low[2] + (k + F32(0.5)) * cell_m
                for q in range(STARTS):
                    seed = nearest[j, k, q]
                    if seed < 0 or found == ROOTS:
                        break
                    x[0], x[1], x[2] = moved(seed_inverses[seed], px, py, pz)
                    if not _solve(
                        transforms, low, nodes_per_m, px, py, pz, x, blend, inverse
                    ) or not _in_band(x, low, cells_per_m, distance, band_m):
                        continue
                    same = False
                    for n in range(total, min(total + found, roots.shape[0])):
                        dx, dy, dz = roots[n, 0] - x[0], roots[n, 1] - x[1], roots[n, 2] - x[2]
                        same |= dx * dx + dy * dy + dz * dz < F32(SAME_ROOT_M * SAME_ROOT_M)
                    if same:
                        continue
                    if total + found < roots.shape[0]:
                        _jacobian_inverse(transforms, low, nodes_per_m, x, blend, jacobian, inverse)
                        for axis in range(3):
                            roots[total + found, axis] = x[axis]
                        for n in range(9):
                            roots[total + found, 3 + n] = inverse[n]
                    found += 1
                if found > 0:
                    index[i, j, k] = total * 4 + found
                    total += found
    return total

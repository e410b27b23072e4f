"""The light of the room: what rays see of the skin's normals, and sums over them, compiled."""

import math

import numpy as np

from avatar.kernels.kernel_compiler import FAST_MATH, INLINED, NO_ALLOCATION, compile_kernel
from avatar.kernels.operands import MAX_LOG_DENSITY

F32, I32, U32 = np.float32, np.int32, np.uint32
MIN_NORMAL_WEIGHT = 1e-3
"""Weight of a sample in its ray up to which its normal does not count."""


@compile_kernel(**INLINED)
def _cell_below(place, count):
    """Index of the cell whose center is before a place, in cells, and how far beyond it that is."""
    before = min(max(place - F32(0.5), F32(0)), F32(count - 1))
    index = min(I32(before), I32(count - 2))
    return index, before - F32(index)


@compile_kernel(**NO_ALLOCATION)
def mean_normal(
    ray, raw, points, offsets, counts, rows, slots, cell_roots, sample_step_m, normals, low,
    cells_per_m, mean,
):  # fmt: skip
    """One ray's composited normal."""
    nx, ny, nz, _ = normals.shape
    slot, through = slots[ray], F32(1)
    x, y, z = F32(0), F32(0), F32(0)
    for i in range(offsets[ray], offsets[ray] + counts[ray]):
        before = through
        through *= np.exp(-np.exp(min(raw[i, 3], F32(MAX_LOG_DENSITY))) * sample_step_m)
        if before - through <= F32(MIN_NORMAL_WEIGHT):
            continue  # most samples, whose normals lie anywhere in memory
        n = U32(rows[i])
        a, f = _cell_below((points[i, 0] - low[0]) * cells_per_m[0], nx)
        b, g = _cell_below((points[i, 1] - low[1]) * cells_per_m[1], ny)
        c, h = _cell_below((points[i, 2] - low[2]) * cells_per_m[2], nz)
        p, q, r = F32(0), F32(0), F32(0)
        for j in range(2):
            for k in range(2):
                side = (f if j else F32(1) - f) * (g if k else F32(1) - g)
                one, other = normals[a + j, b + k, c], normals[a + j, b + k, c + 1]
                p += side * (one[0] + h * (other[0] - one[0]))
                q += side * (one[1] + h * (other[1] - one[1]))
                r += side * (one[2] + h * (other[2] - one[2]))
        # in the body frame: Aᵀ normal, normalised
        u = cell_roots[slot, n, 3] * p + cell_roots[slot, n, 6] * q + cell_roots[slot, n, 9] * r
        v = (
            cell_roots[slot, n, 4] * p + cell_roots[slot, n, 7] * q
            + cell_roots[slot, n, 10] * r
        )  # fmt: skip
        w = (
            cell_roots[slot, n, 5] * p + cell_roots[slot, n, 8] * q
            + cell_roots[slot, n, 11] * r
        )  # fmt: skip
        weight = (before - through) / max(np.sqrt(u * u + v * v + w * w), F32(1e-12))
        x, y, z = x + weight * u, y + weight * v, z + weight * w
    mean[ray, 0], mean[ray, 1], mean[ray, 2] = x, y, z


@compile_kernel(**NO_ALLOCATION)
def mean_normals(
    thread, threads, raw, points, offsets, counts, rows, slots, cell_roots, sample_step_m,
    normals, low, cells_per_m, mean,
):  # fmt: skip
    """Normals at each ray's samples, in the body frame, composited front to back."""
    rays = offsets.shape[0]
    for ray in range(rays * thread // threads, rays * (thread + 1) // threads):
        mean_normal(
            ray, raw, points, offsets, counts, rows, slots, cell_roots, sample_step_m,
            normals, low, cells_per_m, mean,
        )  # fmt: skip


@compile_kernel(**INLINED)
def light_factor(normals, ray, coefficients, min_length, bounds):
    """Factor of the color of what a ray sees, and the length of its normal."""
    x, y, z = normals[ray, 0], normals[ray, 1], normals[ray, 2]
    length = np.sqrt(x * x + y * y + z * z)
    if length <= F32(min_length):
        return F32(1), length
    # c_0 + (c_1, c_2, c_3) · normal / |normal|
    light = coefficients[1] * x + coefficients[2] * y + coefficients[3] * z
    light = coefficients[0] + light / length
    return min(max(light, F32(bounds[0])), F32(bounds[1])), length


@compile_kernel(**FAST_MATH)
def light_factors(normals, coefficients, min_length, bounds, factors):
    """Factors of the premultiplied colors and of alpha, which stays, of rays (rays, 4)."""
    for ray in range(normals.shape[0]):
        factor, _ = light_factor(normals, ray, coefficients, min_length, bounds)
        for q in range(3):
            factors[ray, q] = factor
        factors[ray, 3] = F32(1)


@compile_kernel(**FAST_MATH)
def add_light(
    normals, target, rendered, coefficients, min_alpha, min_length, bounds, memory_rays, sums
):  # fmt: skip
    """Adds rays to the least squares of the light's coefficients; returns how many counted.

    Args:
        normals: World normals of what the rays see.
        target, rendered: Pixels, and their shaded rendering, premultiplied RGBA.
        coefficients: Those that the rendering is shaded by.
        min_alpha: Alpha of both above which a ray counts.
        memory_rays: Rays after which an earlier one weighs 1/e.
        sums: Products, with one another, of each ray's unshaded brightness times the four
            harmonics, and of its pixel's brightness (5, 5); updated.
    """
    added, row, rays = np.zeros((5, 5)), np.empty(5), 0
    for ray in range(normals.shape[0]):
        factor, length = light_factor(normals, ray, coefficients, min_length, bounds)
        if min(target[ray, 3], rendered[ray, 3]) <= min_alpha or length <= min_length:
            continue
        rays += 1
        row[0] = (rendered[ray, 0] + rendered[ray, 1] + rendered[ray, 2]) / (F32(3) * factor)
        for q in range(3):
            row[1 + q] = row[0] * normals[ray, q] / length
        row[4] = (target[ray, 0] + target[ray, 1] + target[ray, 2]) / F32(3)
        for i in range(5):
            for k in range(5):
                added[i, k] += row[i] * row[k]
    kept = math.exp(-rays / memory_rays)
    for i in range(5):
        for k in range(5):
            sums[i, k] = kept * sums[i, k] + added[i, k]
    return rays

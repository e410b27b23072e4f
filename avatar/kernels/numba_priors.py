"""Gradients of the field's priors and draws of the points they hold at, compiled for the CPU.

The priors count where rays do not determine the field: empty off the body, solid inside, smooth.
Most terms penalise the opacity of one centimetre, α = 1 - exp(-σ · 1 cm), as in the paper's code,
where s is the log density and dα/ds = σ · 1 cm · (1 - α). Each kernel adds the gradient of a mean
over points, times a weight, with respect to the raw outputs. Pairs are stored as all first points,
then all second ones.
"""

import math

import numpy as np

from avatar.kernels.kernel_compiler import FAST_MATH, INLINED, compile_kernel
from avatar.kernels.numba_rendering import sigmoid
from avatar.kernels.operands import MAX_LOG_DENSITY

F32, U32 = np.float32, np.uint32
OPACITY_LENGTH_M = 0.01
"""Length over which opacity is measured, metres."""
MAX_USEFUL_LOG_DENSITY = 6.0
"""Log density above which density is excess (400 per metre: opacity 0.5 in two millimetres)."""
SOURCE_STEEPNESS = 3.0
"""Factor of a source's opacity about one half."""


@compile_kernel(**INLINED)
def _opacity(log_density):
    """Opacity of one centimetre, α = 1 - exp(-σ · 1 cm), and dα / d log σ."""
    optical = np.exp(min(log_density, F32(MAX_LOG_DENSITY))) * F32(OPACITY_LENGTH_M)
    through = np.exp(-optical)
    return F32(1) - through, optical * through


@compile_kernel(**INLINED)
def _sign(x):
    return F32(x > F32(0)) - F32(x < F32(0))


@compile_kernel(**FAST_MATH)
def empty_space(raw, weight, grad):
    """Adds the gradient of the mean α in space that should be empty (the paper's §3.4)."""
    share = weight / F32(max(raw.shape[0], 1))
    for i in range(raw.shape[0]):
        grad[i, 3] += share * _opacity(raw[i, 3])[1]


@compile_kernel(**FAST_MATH)
def interior(raw, weight, grad):
    """Adds the gradient of the mean -log α in the interior; it acts at zero opacity as well."""
    share = weight / F32(max(raw.shape[0], 1))
    for i in range(raw.shape[0]):
        value, slope = _opacity(raw[i, 3])
        grad[i, 3] -= share * slope / max(value, F32(1e-6))


@compile_kernel(**FAST_MATH)
def log_density_l1(raw, weight, grad):
    """Adds the gradient of the mean log density where it is above 0.

    Density that a ray needs withstands the small gradient; under Adam, density that no ray needs
    vanishes however small the gradient is.
    """
    share = weight / F32(max(raw.shape[0], 1))
    for i in range(raw.shape[0]):
        if raw[i, 3] > F32(0):
            grad[i, 3] += share


@compile_kernel(**FAST_MATH)
def density_tv(raw, weight, grad):
    """Adds the gradient of the mean |α - α'| over pairs of points.

    The total variation of a solid is its surface area (Rudin, Osher and Fatemi 1992); of all
    surfaces that explain the images it prefers the smallest, which is the smoothest. It does not
    penalise sharp edges, but it does not penalise thick, half-transparent layers either.
    """
    count = raw.shape[0] // 2
    share = weight / F32(max(count, 1))
    for i in range(count):
        one, one_slope = _opacity(raw[i, 3])
        other, other_slope = _opacity(raw[count + i, 3])
        sign = _sign(one - other)
        grad[i, 3] += share * sign * one_slope
        grad[count + i, 3] -= share * sign * other_slope


@compile_kernel(**FAST_MATH)
def double_well(raw, weight, grad):
    """Adds the gradient of the mean α (1 - α), which vanishes where space is opaque or empty.

    Together with the total variation it minimises fog and surface area, as between two phases of a
    fluid (Modica and Mortola 1977).
    """
    share = weight / F32(max(raw.shape[0], 1))
    for i in range(raw.shape[0]):
        value, slope = _opacity(raw[i, 3])
        grad[i, 3] += share * (F32(1) - F32(2) * value) * slope


@compile_kernel(**FAST_MATH)
def density_slope(raw, points, max_slope_per_m, weight, grad):
    """Adds the gradient of the mean of max(0, |s - s'| - k |x - x'|), and of density in excess.

    A few images in slightly wrong poses are explained as well by a razor-sharp surface that is
    rough between pixels. Neither the renderer's samples nor the player's voxels can represent it: a
    shift of the samples by half a step changed the image by 38 dB. Density above
    `MAX_USEFUL_LOG_DENSITY` is penalised too, since it only steepens the edge. k is
    `max_slope_per_m`.
    """
    count = raw.shape[0] // 2
    share = weight / F32(max(count, 1))
    excess = weight * F32(0.4) / F32(max(2 * count, 1))
    for i in range(count):
        one, other, square = raw[i, 3], raw[count + i, 3], F32(0)
        for axis in range(3):
            apart = points[i, axis] - points[count + i, axis]
            square += apart * apart
        change = one - other
        if max(one, other) > F32(0) and abs(change) > max_slope_per_m * np.sqrt(square):
            pull = share * _sign(change)
            grad[i, 3] += pull
            grad[count + i, 3] -= pull
        grad[i, 3] += excess * F32(one > F32(MAX_USEFUL_LOG_DENSITY))
        grad[count + i, 3] += excess * F32(other > F32(MAX_USEFUL_LOG_DENSITY))


@compile_kernel(**FAST_MATH)
def color_tv(raw, weight, grad):
    """Adds the gradient of the mean |c - c'| of visible pairs, as in `density_tv`."""
    count = raw.shape[0] // 2
    share = weight / F32(max(count, 1))
    for i in range(count):
        if max(raw[i, 3], raw[count + i, 3]) <= F32(2.0):  # both invisible
            continue
        for q in range(3):
            one, other = sigmoid(raw[i, q]), sigmoid(raw[count + i, q])
            pull = share * _sign(one - other)
            grad[i, q] += pull * one * (F32(1) - one)
            grad[count + i, q] -= pull * other * (F32(1) - other)


@compile_kernel(**FAST_MATH)
def toward_sources(raw, weights, weight, grad):
    """Adds the gradient of the cross-entropy of points to their sources, in opacity and in color.

    Cross-entropy acts where a point is empty and its source is not, too. The sources stand still.
    Their opacity is steepened about one half, so that the copy of a soft surface is firm; their
    color counts as far as they are opaque. `weights` are the pairs' own, in [0, 1].
    """
    count = weights.shape[0]
    for i in range(count):
        scale = weight * weights[i]
        opacity, source = _opacity(raw[i, 3])[0], _opacity(raw[count + i, 3])[0]
        firm = min(max(F32(0.5) + F32(SOURCE_STEEPNESS) * (source - F32(0.5)), F32(0)), F32(1))
        for q in range(3):
            apart = sigmoid(raw[i, q]) - sigmoid(raw[count + i, q])
            grad[i, q] += scale * source * apart
        grad[i, 3] += scale * (opacity - firm)


@compile_kernel(**FAST_MATH)
def points_in_cells(cells, within, shape, low, cells_per_m, points):
    """Points in flat `cells` of a grid, at the places `within` them in [0, 1) (cells, 3)."""
    _, ny, nz = shape
    for i in range(cells.shape[0]):
        cell = cells[i]
        points[i, 0] = (F32(cell // (ny * nz)) + within[i, 0]) / cells_per_m[0] + low[0]
        points[i, 1] = (F32(cell // nz % ny) + within[i, 1]) / cells_per_m[1] + low[1]
        points[i, 2] = (F32(cell % nz) + within[i, 2]) / cells_per_m[2] + low[2]


@compile_kernel(**INLINED)
def chance(seed, number):
    """A random number in [0, 1): a hash of its number (Wellons' lowbias32) that depends on a seed.

    It does not depend on the number of threads, and no array of random numbers is filled before.
    """
    x = U32(U32(number) ^ U32(seed))
    x = U32(U32(x ^ (x >> U32(16))) * U32(0x7FEB352D))
    x = U32(U32(x ^ (x >> U32(15))) * U32(0x846CA68B))
    return F32(U32(x ^ (x >> U32(16))) >> U32(8)) * F32(2.0**-24)


@compile_kernel(**FAST_MATH)
def draw_pairs(seed, sigma, points, pairs):
    """Random points, then a neighbor of each at a normal offset of `sigma` along each axis.

    Normal numbers are Box and Muller's (1958), from a radius and a direction each.
    """
    count, offset = pairs.shape[0] // 2, np.empty(4, F32)
    for i in range(count):
        place = chance(seed, 5 * i) * F32(points.shape[0])
        drawn = min(np.int64(place), points.shape[0] - 1)
        for half in range(2):
            far, turn = chance(seed, 5 * i + 1 + half), chance(seed, 5 * i + 3 + half)
            radius = sigma * np.sqrt(F32(-2) * np.log(F32(1) - far))
            angle = F32(2.0 * math.pi) * turn
            offset[2 * half], offset[2 * half + 1] = radius * np.cos(angle), radius * np.sin(angle)
        for axis in range(3):
            pairs[i, axis] = points[drawn, axis]
            pairs[count + i, axis] = points[drawn, axis] + offset[axis]

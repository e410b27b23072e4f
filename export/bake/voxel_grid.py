"""Voxel grids: filters that the proxy surface and the mesh share, and isosurface extraction.

Isosurfaces are naive surface nets: one vertex for each crossed cell.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64
from scipy import ndimage

MIN_PART_FRACTION = 0.0002
"""Least volume of a part as a fraction of the largest one's; smaller ones are floaters. At ten
times this, a foot that few photographs had left in fragments was lost, and a wrist."""


def resample_grid(
    values: Float32[np.ndarray, "x y z"], step: float
) -> Float32[np.ndarray, "x2 y2 z2"]:
    """Interpolate linearly at every `step`-th node along each axis, which has two nodes or more."""
    lower, shares = [], []
    for size in values.shape:
        places = np.arange(0.0, size - 1, step)
        # rounding may put the last place on the last node, which begins no cell
        lower.append(np.minimum(places.astype(int), size - 2))
        shares.append((places - lower[-1]).astype(np.float32))
    (x, y, z), (_, along_y, along_z) = lower, shares
    out = np.empty([len(axis) for axis in lower], dtype=np.float32)
    for plane, below, share in zip(out, x, shares[0], strict=True):  # planes fit into caches
        rows = values[below] + (values[below + 1] - values[below]) * share
        rows = rows[y] + (rows[y + 1] - rows[y]) * along_y[:, None]
        left = rows[:, z]
        plane[:] = left + (rows[:, z + 1] - left) * along_z
    return out


def blur_grid(values: Float32[np.ndarray, "x y z"], sigma: float) -> Float32[np.ndarray, "x y z"]:
    """Convolve with a Gaussian up to three standard deviations; two halves side by side."""
    radius, middle = int(3.0 * sigma + 0.5), len(values) // 2
    with ThreadPoolExecutor(1) as beside:
        upper = beside.submit(
            ndimage.gaussian_filter, values[max(middle - radius, 0) :], sigma, truncate=3.0
        )
        lower = ndimage.gaussian_filter(values[: middle + radius], sigma, truncate=3.0)
    return np.concatenate([lower[:middle], upper.result()[min(middle, radius) :]])


def dilate(solid: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """Add the 26 neighbors of each node."""
    for axis in range(3):
        out = solid.copy()
        here, beyond = [slice(None)] * 3, [slice(None)] * 3
        here[axis], beyond[axis] = slice(None, -1), slice(1, None)
        out[tuple(here)] |= solid[tuple(beyond)]
        out[tuple(beyond)] |= solid[tuple(here)]
        solid = out
    return solid


def remove_floaters_and_cavities(solid: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """Remove small components and fill what the others enclose; the first node is outside.

    Components are connected through faces.
    """
    parts = _label_components(solid)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return fill_cavities((sizes >= MIN_PART_FRACTION * sizes.max())[parts])


def fill_cavities(solid: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """Fill what is enclosed; the first node is outside."""
    outside = _label_components(~solid)
    return outside != outside[0, 0, 0]


def _label_components(mask: Bool[np.ndarray, "x y z"]) -> Int32[np.ndarray, "x y z"]:
    """Number the connected components from 1; 0 outside the mask."""
    parts = np.zeros(mask.shape, dtype=np.int32)
    ndimage.label(mask, output=parts)
    return parts


CORNERS = np.array(list(np.ndindex(2, 2, 2)))
"""Corners of a cell, relative to its lowest one."""
AXES = np.eye(3, dtype=np.int64)
"""Steps along x, y and z."""


def extract_isosurface(
    values: Float32[np.ndarray, "x y z"],
) -> tuple[Float32[np.ndarray, "vertices 3"], Int32[np.ndarray, "faces 3"]]:
    """Return vertices in nodes of the grid, and triangles that face from positive to negative.

    Every cell that the zero set crosses has one vertex, the mean of its crossings of the cell's
    edges; every crossed grid edge has a quad between its four cells (Gibson 1998, "Constrained
    elastic surface nets", without the relaxation). The surface is closed if the border is negative.
    """
    inside = values > 0.0
    cells = _crossed_cells(inside)
    vertices = _mean_crossings(values, inside, cells)
    number = np.full(np.array(values.shape) - 1, -1, dtype=np.int32)
    number[tuple(cells.T)] = np.arange(len(cells), dtype=np.int32)
    quads = [_quads(inside, number, axis) for axis in range(3)]
    return vertices, _triangles(vertices, np.concatenate(quads))


def _crossed_cells(inside: Bool[np.ndarray, "x y z"]) -> Int64[np.ndarray, "cells 3"]:
    """Return the lowest corners of cells with corners on both sides."""
    x, y, z = (size - 1 for size in inside.shape)
    count = np.zeros((x, y, z), dtype=np.uint8)
    for i, j, k in CORNERS:
        count += inside[i : i + x, j : j + y, k : k + z]
    return np.argwhere((count > 0) & (count < len(CORNERS)))


def _mean_crossings(
    values: Float32[np.ndarray, "x y z"],
    inside: Bool[np.ndarray, "x y z"],
    cells: Int64[np.ndarray, "cells 3"],
) -> Float32[np.ndarray, "cells 3"]:
    total = np.zeros((len(cells), 3), dtype=np.float64)
    count = np.zeros(len(cells), dtype=np.int64)
    for axis in range(3):
        for corner in CORNERS[CORNERS[:, axis] == 0]:
            start, end = tuple((cells + corner).T), tuple((cells + corner + AXES[axis]).T)
            crossed = np.flatnonzero(inside[start] != inside[end])
            a, b = values[start][crossed], values[end][crossed]
            share = (a / (a - b)).astype(np.float64)
            total[crossed] += corner + share[:, None] * AXES[axis]
            count[crossed] += 1
    return (cells + total / count[:, None]).astype(np.float32)


def _quads(
    inside: Bool[np.ndarray, "x y z"], number: Int32[np.ndarray, "cx cy cz"], axis: int
) -> Int32[np.ndarray, "quads 4"]:
    """Return the four cells about every crossed edge, counter-clockwise from outside."""
    here = [slice(1, -1)] * 3
    there = list(here)
    here[axis], there[axis] = slice(0, -1), slice(1, None)
    leaves, enters = inside[tuple(here)], inside[tuple(there)]
    offset = 1 - AXES[axis]
    nodes = np.argwhere(leaves != enters) + offset
    u, v = AXES[(axis + 1) % 3], AXES[(axis + 2) % 3]
    quads = np.stack([number[tuple((nodes - c).T)] for c in (u + v, v, 0 * u, u)], axis=1)
    outward = leaves[tuple((nodes - offset).T)]
    return np.where(outward[:, None], quads, quads[:, ::-1])


def _triangles(
    vertices: Float32[np.ndarray, "vertices 3"], quads: Int32[np.ndarray, "quads 4"]
) -> Int32[np.ndarray, "faces 3"]:
    """Split each quad along its shorter diagonal."""
    a, b, c, d = (vertices[corner] for corner in quads.T)
    shorter = np.linalg.norm(a - c, axis=1) <= np.linalg.norm(b - d, axis=1)
    along = np.where(shorter[:, None], quads, np.roll(quads, -1, axis=1))
    return np.concatenate([along[:, [0, 1, 2]], along[:, [0, 2, 3]]])

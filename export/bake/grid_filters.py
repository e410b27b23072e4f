"""Filters of voxel grids that the proxy surface and the mesh share."""

import numpy as np
from jaxtyping import Bool, Float32, Int32
from scipy import ndimage


def resample_grid(
    values: Float32[np.ndarray, "x y z"], step: float
) -> Float32[np.ndarray, "x2 y2 z2"]:
    """Interpolate linearly at every `step`-th node along each axis, which has two nodes or more."""
    for axis in range(3):
        places = np.arange(0.0, values.shape[axis] - 1, step)
        # rounding may put the last place on the last node, which begins no cell
        below = np.minimum(places.astype(int), values.shape[axis] - 2)
        shape = [1, 1, 1]
        shape[axis] = -1
        part = (places - below).astype(np.float32).reshape(shape)
        lower = np.take(values, below, axis=axis)
        values = lower + (np.take(values, below + 1, axis=axis) - lower) * part
    return values


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


def remove_floaters_and_cavities(
    solid: Bool[np.ndarray, "x y z"], min_fraction: float
) -> Bool[np.ndarray, "x y z"]:
    """Remove small components and fill what the others enclose; the first node is outside.

    Args:
        solid: Nodes inside; components are connected through faces.
        min_fraction: Least volume of a component as a fraction of the largest one's.
    """
    parts = _label_components(solid)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    outside = _label_components(~(sizes >= min_fraction * sizes.max())[parts])
    return outside != outside[0, 0, 0]


def _label_components(mask: Bool[np.ndarray, "x y z"]) -> Int32[np.ndarray, "x y z"]:
    """Number the connected components from 1; 0 outside the mask."""
    parts = np.zeros(mask.shape, dtype=np.int32)
    ndimage.label(mask, output=parts)
    return parts

"""Compiled loops of baking: walks along normals, and colors of neighbors."""

import numpy as np
from jaxtyping import Bool, UInt8

from avatar.kernels.kernel_compiler import compile_kernel
from export.bake.grid_filters import dilate

F32, I32 = np.float32, np.int32


@compile_kernel(nogil=True, error_model="numpy")
def visible_depth_steps(
    density, low, voxel_m, positions, normals, step, max_steps, opaque, fraction
):
    """Count the steps along each inward normal until everything visible has been passed.

    Args:
        density: On nodes, 1/m.
        low, voxel_m: Position of the first node and distance between nodes, metres.
        positions, normals: Where to start, and the outward direction.
        step: Distance between steps, metres.
        max_steps: Steps to take.
        opaque: Optical depth behind which nothing is visible.
        fraction: Fraction of the optical depth of all steps that is enough, too.
    """
    ends = np.empty(len(positions), dtype=np.int32)
    along = np.empty(max_steps, dtype=np.float32)
    last_i, last_j, last_k = density.shape[0] - 1, density.shape[1] - 1, density.shape[2] - 1
    for p in range(len(positions)):
        # the whole walk comes first: thin parts are enough at a fraction of their own total
        total = F32(0)
        for n in range(max_steps):
            depth = (F32(n) + F32(0.5)) * step
            i = I32(np.rint((positions[p, 0] - normals[p, 0] * depth - low[0]) / voxel_m))
            j = I32(np.rint((positions[p, 1] - normals[p, 1] * depth - low[1]) / voxel_m))
            k = I32(np.rint((positions[p, 2] - normals[p, 2] * depth - low[2]) / voxel_m))
            i, j, k = min(max(i, 0), last_i), min(max(j, 0), last_j), min(max(k, 0), last_k)
            total += density[i, j, k] * step
            along[n] = total
        enough = min(F32(opaque), F32(fraction) * total)
        seen = 0
        while seen < max_steps and along[seen] < enough:
            seen += 1
        ends[p] = seen
    return ends


@compile_kernel(nogil=True, error_model="numpy")
def mark_visible_nodes(visible, low, voxel_m, positions, normals, thickness, margin_m):
    """Mark the nodes along each normal, from a margin outside to the thickness inside."""
    last_i, last_j, last_k = visible.shape[0] - 1, visible.shape[1] - 1, visible.shape[2] - 1
    for p in range(len(positions)):
        depth = -margin_m
        while depth <= thickness[p]:
            i = I32(np.rint((positions[p, 0] - normals[p, 0] * depth - low[0]) / voxel_m))
            j = I32(np.rint((positions[p, 1] - normals[p, 1] * depth - low[1]) / voxel_m))
            k = I32(np.rint((positions[p, 2] - normals[p, 2] * depth - low[2]) / voxel_m))
            i, j, k = min(max(i, 0), last_i), min(max(j, 0), last_j), min(max(k, 0), last_k)
            visible[i, j, k] = True
            depth += voxel_m


@compile_kernel(nogil=True, error_model="numpy")
def _mean_colors(visible, rgb, nodes):
    """Write the mean color of the visible ones among 26 neighbors to some nodes."""
    _, ny, nz = visible.shape
    for node in nodes:
        i, j, k = node // (ny * nz), node // nz % ny, node % nz
        red, green, blue, count = 0, 0, 0, 0
        for a in range(i - 1, i + 2):
            for b in range(j - 1, j + 2):
                for c in range(k - 1, k + 2):
                    if visible[a, b, c]:
                        red += rgb[a, b, c, 0]
                        green += rgb[a, b, c, 1]
                        blue += rgb[a, b, c, 2]
                        count += 1
        rgb[i, j, k, 0] = np.uint8(np.rint(red / count))
        rgb[i, j, k, 1] = np.uint8(np.rint(green / count))
        rgb[i, j, k, 2] = np.uint8(np.rint(blue / count))


def dilate_colors(visible: Bool[np.ndarray, "x y z"], rgb: UInt8[np.ndarray, "x y z 3"]) -> None:
    """Give each empty node next to visible ones their mean color, in place.

    Color is interpolated between a visible and an empty node as well: black would darken the rim.
    The grid's border is left unchanged and counts as empty.
    """
    inner = np.zeros_like(visible)
    inner[1:-1, 1:-1, 1:-1] = visible[1:-1, 1:-1, 1:-1]
    beside = dilate(inner) & ~inner
    beside[[0, -1]] = beside[:, [0, -1]] = beside[:, :, [0, -1]] = False
    _mean_colors(inner, rgb, np.flatnonzero(beside))


def warm_up() -> None:
    """Compile these loops, or load them from disk, before a package is waited for."""
    nodes, point = np.zeros((3, 3, 3), dtype=np.float32), np.ones((1, 3), dtype=np.float32)
    low, size = point[0], np.float32(1.0)
    visible_depth_steps(nodes, low, size, point, point, size, 1, 7.0, 0.999)
    mark_visible_nodes(nodes > 0, low, size, point, point, low[:1], size)
    solid = np.zeros((3, 3, 3), dtype=bool)
    solid[1, 1, 1] = True
    dilate_colors(solid, np.zeros((3, 3, 3, 3), dtype=np.uint8))

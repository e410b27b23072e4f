"""The trained field on a voxel grid, and its proxy surface: points just outside what is visible.

The field is sampled once; everything else is baked from that grid. The proxy surface is a level set
with normals and the thickness under it that is visible.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, Int64, UInt8

from avatar.kernels.kernel_compiler import compile_kernel
from avatar.rig import Rig
from export.bake.voxel_grid import blur_grid, dilate, remove_floaters_and_cavities, resample_grid
from export.package.player_tables import BRICK_SIZE, LOG_DENSITY_RANGE

F32, I32 = np.float32, np.int32


@compile_kernel(nogil=True, error_model="numpy", forceinline=True)
def _node_under(positions, normals, p, depth, low, voxel_m, shape):
    """Return the node nearest to the place at a depth under a point of the surface."""
    i = I32(np.rint((positions[p, 0] - normals[p, 0] * depth - low[0]) / voxel_m))
    j = I32(np.rint((positions[p, 1] - normals[p, 1] * depth - low[1]) / voxel_m))
    k = I32(np.rint((positions[p, 2] - normals[p, 2] * depth - low[2]) / voxel_m))
    return (
        min(max(i, 0), shape[0] - 1), min(max(j, 0), shape[1] - 1), min(max(k, 0), shape[2] - 1)
    )  # fmt: skip


@compile_kernel(nogil=True, error_model="numpy")
def visible_depth_steps(
    density, low, voxel_m, positions, normals, step, max_steps, opaque, fraction
):
    """Count the steps along each inward normal until everything visible has been passed.

    `density` (1/m) lies on nodes, and `normals` point outwards. Nothing is visible behind the
    optical depth `opaque`, or behind a `fraction` of the optical depth of all steps.
    """
    ends = np.empty(len(positions), dtype=np.int32)
    along = np.empty(max_steps, dtype=np.float32)
    for p in range(len(positions)):
        # the whole walk comes first: thin parts are enough at a fraction of their own total
        total = F32(0)
        for n in range(max_steps):
            depth = (F32(n) + F32(0.5)) * step
            i, j, k = _node_under(positions, normals, p, depth, low, voxel_m, density.shape)
            total += density[i, j, k] * step  # the optical depth, Σ σ Δ
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
    for p in range(len(positions)):
        depth = -margin_m
        while depth <= thickness[p]:
            i, j, k = _node_under(positions, normals, p, depth, low, voxel_m, visible.shape)
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


FieldFunction = Callable[
    [Float32[torch.Tensor, "points 3"]],
    tuple[Float32[torch.Tensor, "points 3"], Float32[torch.Tensor, "points"]],
]
"""Evaluates color in [0, 1] and density in 1/m at canonical points."""
CHUNK_POINTS = 1 << 16
"""Points per evaluation of the field; their colors fit into a cache."""
MIN_DENSITY = float(np.exp(LOG_DENSITY_RANGE[0]))
"""Density below which a node is empty, 1/m."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FieldGrid:
    """Density and color on nodes `low + voxel_m · (i, j, k)`; each count is a multiple of 8, + 1.

    Canonical metres, and 1/m. Empty nodes next to visible ones hold the mean of their colors.
    """

    low: Float32[np.ndarray, "3"]
    voxel_m: float
    density: Float32[np.ndarray, "x y z"]
    rgb: UInt8[np.ndarray, "x y z 3"]


def sample_field_grid(
    field_at: FieldFunction, rig: Rig, occupied: UInt8[np.ndarray, "cx cy cz"], voxel_m: float
) -> FieldGrid:
    """Sample the field at every node inside an occupied cell; the others are empty."""
    cells = np.argwhere(occupied)
    first, last = cells.min(axis=0), cells.max(axis=0)
    cell = (rig.box_high - rig.box_low) / occupied.shape
    low = (rig.box_low + (first - 1) * cell).astype(np.float32)
    extent = (last - first + 3) * cell
    counts = np.ceil(extent / (voxel_m * BRICK_SIZE)).astype(int) * BRICK_SIZE + 1
    density = np.zeros(counts, dtype=np.float32)
    rgb = np.zeros((*counts, 3), dtype=np.uint8)
    axes = [(low[k] + np.arange(counts[k]) * voxel_m).astype(np.float32) for k in range(3)]
    places = _occupied_nodes(occupied, (low - rig.box_low) / cell, voxel_m / cell, counts)
    for start in range(0, len(places), CHUNK_POINTS):
        place = places[start : start + CHUNK_POINTS]
        nodes = np.unravel_index(place, counts)
        points = np.stack([axis[node] for axis, node in zip(axes, nodes, strict=True)], axis=1)
        with torch.no_grad():
            colors, densities = field_at(torch.from_numpy(points))
        density.ravel()[place] = densities.numpy()
        rgb.reshape(-1, 3)[place] = np.round(np.clip(colors.numpy(), 0, 1) * 255.0).astype(np.uint8)
    dilate_colors(density > MIN_DENSITY, rgb)
    return FieldGrid(low=low, voxel_m=voxel_m, density=density, rgb=rgb)


def _occupied_nodes(
    occupied: UInt8[np.ndarray, "cx cy cz"],
    offset: Float[np.ndarray, "3"],
    step: Float[np.ndarray, "3"],
    counts: Int[np.ndarray, "3"],
) -> Int64[np.ndarray, "nodes"]:
    """Return the flat indices of nodes inside occupied cells."""
    padded = np.pad(occupied, 1)
    cells = [
        np.clip(np.floor(offset[k] + np.arange(counts[k]) * step[k]).astype(int) + 1, 0, size - 1)
        for k, size in enumerate(padded.shape)
    ]
    return np.flatnonzero(padded[:, :, cells[2]][:, cells[1]][cells[0]])


DENSITY_CONTRAST = 16.0
"""Factor about the level to which densities are clipped, as emptiness has no logarithm."""
OPAQUE_OPTICAL_DEPTH = 7.0
"""Optical depth behind which nothing is visible (0.1 %)."""
THICKNESS_MARGIN_M = 0.004
"""Added to the thickness, metres, for what lies deeper beside the normal than along it."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ProxySurface:
    """Canonical positions, outward unit normals and visible depth of a person's surface.

    Attributes:
        spacing_m: Cell of the grid on which the level set was extracted.
        thickness: Depth along the inward normal to which the field is visible, metres.
    """

    spacing_m: float
    positions: Float32[np.ndarray, "surfels 3"]
    normals: Float32[np.ndarray, "surfels 3"]
    thickness: Float32[np.ndarray, "surfels"]


def extract_proxy_surface(grid: FieldGrid, *, level: float, spacing_m: float) -> ProxySurface:
    """Extract the outer level set of the blurred log-density, without floaters and cavities.

    A lower `level` (1/m) lets invisible haze shape the surface; a higher one cuts into the visible
    field. Surfels lie on the edges of cells of `spacing_m`.
    """
    logs = resample_grid(_log_density(grid, level), spacing_m / grid.voxel_m)
    logs = blur_grid(logs, 0.004 / spacing_m)
    inside = remove_floaters_and_cavities(logs > 0.0)
    nothing = np.float32(1e-3)
    logs = np.where(inside, np.maximum(logs, nothing), np.minimum(logs, -nothing))
    nodes, normals = _zero_crossings(logs, blur_grid(logs, 1.0))
    positions = (grid.low + nodes * spacing_m).astype(np.float32)
    return ProxySurface(
        spacing_m=spacing_m,
        positions=positions,
        normals=normals,
        thickness=_visible_thickness(grid, positions, normals),
    )


def _log_density(grid: FieldGrid, level: float) -> Float32[np.ndarray, "x y z"]:
    """Return the logarithm of density over level, clipped to `DENSITY_CONTRAST`."""
    # most nodes are empty: take logarithms of the others alone
    logs = np.full(grid.density.shape, -np.log(DENSITY_CONTRAST), dtype=np.float32)
    places = np.flatnonzero(grid.density > np.float32(level / DENSITY_CONTRAST))
    dense = grid.density.ravel()[places] / np.float32(level)
    logs.ravel()[places] = np.log(np.clip(dense, 1.0 / DENSITY_CONTRAST, DENSITY_CONTRAST))
    return logs


def _zero_crossings(
    logs: Float32[np.ndarray, "x y z"], smoothed: Float32[np.ndarray, "x y z"]
) -> tuple[Float32[np.ndarray, "surfels 3"], Float32[np.ndarray, "surfels 3"]]:
    """Return zero crossings of edges, in nodes, and unit normals of the smoother grid."""
    inside = logs > 0

    def crossings(along: Int[np.ndarray, "3"]) -> tuple[np.ndarray, np.ndarray]:
        here = tuple(slice(1, -1) for _ in range(3))
        there = tuple(slice(1 + a, -1 + a or None) for a in along)
        start = np.argwhere(inside[here] != inside[there]) + 1
        low, high = logs[tuple(start.T)], logs[tuple((start + along).T)]
        share = (low / (low - high))[:, None]
        normal = (
            _central_differences(smoothed, start) * (1 - share)
            + _central_differences(smoothed, start + along) * share
        )
        length = np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        return (start + along * share).astype(np.float32), (-normal / length).astype(np.float32)

    with ThreadPoolExecutor(2) as threads:
        nodes, normals = zip(*threads.map(crossings, np.eye(3, dtype=int)), strict=True)
    return np.concatenate(nodes), np.concatenate(normals)


def _central_differences(
    values: Float32[np.ndarray, "x y z"], nodes: Int[np.ndarray, "nodes 3"]
) -> Float32[np.ndarray, "nodes 3"]:
    """Return central differences at some nodes, per two nodes."""
    parts = []
    last = np.array(values.shape) - 1
    for along in np.eye(3, dtype=int):
        ahead, behind = np.minimum(nodes + along, last), np.maximum(nodes - along, 0)
        parts.append(values[tuple(ahead.T)] - values[tuple(behind.T)])
    return np.stack(parts, axis=1)


def _visible_thickness(
    grid: FieldGrid,
    positions: Float32[np.ndarray, "surfels 3"],
    normals: Float32[np.ndarray, "surfels 3"],
) -> Float32[np.ndarray, "surfels"]:
    """Return the visible depth under each point, metres, plus `THICKNESS_MARGIN_M`.

    There the optical depth is `OPAQUE_OPTICAL_DEPTH`, or 99.9 % of that in a depth of 10 cm.
    """
    step = np.float32(0.5 * grid.voxel_m)
    ends = visible_depth_steps(
        grid.density, grid.low, np.float32(grid.voxel_m), positions, normals, step,
        int(0.1 / step), OPAQUE_OPTICAL_DEPTH, 0.999,
    )  # fmt: skip
    return ((ends + 1) * step + THICKNESS_MARGIN_M).astype(np.float32)

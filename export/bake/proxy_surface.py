"""The surface: points on a level set just outside of what can be seen, with normals and depth."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int, Int32
from scipy import ndimage

from export.bake.bake_kernels import visible_depth_steps
from export.bake.field_grid import FieldGrid
from export.mesh.isosurface import resample_grid

DENSITY_CONTRAST = 16.0
"""Densities beyond this factor from the level count as the factor: emptiness has no log."""
SMOOTHING_M = 0.004
"""Deviation of the blur before the level is taken: a trained field is never quite smooth."""
MIN_PART_FRACTION = 0.0002
"""Parts of less volume than this share of the largest are floaters. At ten times as much a foot
that a few photographs left in pieces was gone."""
OPAQUE_OPTICAL_DEPTH = 7.0
"""Optical depth behind which nothing is seen (0.1 %)."""
THICKNESS_MARGIN_M = 0.004
"""Added to the thickness, for what lies deeper beside the normal than along it."""
MAX_THICKNESS_M = 0.1
"""Nothing is looked for deeper than this under the surface."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ProxySurface:
    """A person's surface in canonical space.

    Attributes:
        spacing_m: Cell of the grid that the level set was taken on.
        positions: Metres.
        normals: Outward, of length 1.
        thickness: How deep one sees into it along the normal, metres.
    """

    spacing_m: float
    positions: Float32[np.ndarray, "surfels 3"]
    normals: Float32[np.ndarray, "surfels 3"]
    thickness: Float32[np.ndarray, "surfels"]


def extract_proxy_surface(grid: FieldGrid, *, level: float, spacing_m: float) -> ProxySurface:
    """The outer level set of the blurred log-density, without floaters and hollows.

    Args:
        grid: The field.
        level: Density in 1/m. Lower, and haze that nobody sees shapes the surface; higher, and it
            cuts into what is seen.
        spacing_m: Cell of the grid that the set is taken on; surfels sit on its edges.
    """
    logs = resample_grid(_log_density(grid, level), spacing_m / grid.voxel_m)
    logs = ndimage.gaussian_filter(logs, SMOOTHING_M / spacing_m, truncate=3.0)
    inside = _remove_floaters_and_cavities(logs > 0.0)
    nothing = np.float32(1e-3)
    logs = np.where(inside, np.maximum(logs, nothing), np.minimum(logs, -nothing))
    slope = ndimage.gaussian_filter(logs, 1.0, truncate=3.0)
    nodes, normals = _zero_crossings(logs, slope)
    positions = (grid.low + nodes * spacing_m).astype(np.float32)
    return ProxySurface(
        spacing_m=spacing_m,
        positions=positions,
        normals=normals,
        thickness=_visible_thickness(grid, positions, normals),
    )


def _log_density(grid: FieldGrid, level: float) -> Float32[np.ndarray, "x y z"]:
    """Logarithm of the density over the level, within `CONTRAST`; most nodes are empty."""
    logs = np.full(grid.density.shape, -np.log(DENSITY_CONTRAST), dtype=np.float32)
    places = np.flatnonzero(grid.density > np.float32(level / DENSITY_CONTRAST))
    dense = grid.density.ravel()[places] / np.float32(level)
    logs.ravel()[places] = np.log(np.clip(dense, 1.0 / DENSITY_CONTRAST, DENSITY_CONTRAST))
    return logs


def _remove_floaters_and_cavities(solid: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """Solid without floaters, and with what it encloses."""
    parts = _label_components(solid)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    kept = sizes >= MIN_PART_FRACTION * sizes.max()
    outside = _label_components(~kept[parts])
    return outside != outside[0, 0, 0]


def _label_components(mask: Bool[np.ndarray, "x y z"]) -> Int32[np.ndarray, "x y z"]:
    """The number of each connected part; 0 outside of the mask."""
    parts = np.zeros(mask.shape, dtype=np.int32)
    ndimage.label(mask, output=parts)
    return parts


def _zero_crossings(
    logs: Float32[np.ndarray, "x y z"], smoothed: Float32[np.ndarray, "x y z"]
) -> tuple[Float32[np.ndarray, "surfels 3"], Float32[np.ndarray, "surfels 3"]]:
    """Where grid edges cross zero (marching cubes' vertices), in nodes, and the unit normals.

    `slope` is a smoother version of `logs`, for the normals.
    """
    nodes, normals = [], []
    for axis in range(3):
        along = np.eye(3, dtype=int)[axis]
        here = tuple(slice(1, -1) for _ in range(3))
        there = tuple(slice(1 + a, -1 + a or None) for a in along)
        start = np.argwhere((logs[here] > 0) != (logs[there] > 0)) + 1
        low, high = logs[tuple(start.T)], logs[tuple((start + along).T)]
        share = (low / (low - high))[:, None]
        normal = (
            _central_differences(smoothed, start) * (1 - share)
            + _central_differences(smoothed, start + along) * share
        )
        nodes.append(start + along * share)
        normals.append(-normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9))
    return np.concatenate(nodes).astype(np.float32), np.concatenate(normals).astype(np.float32)


def _central_differences(
    values: Float32[np.ndarray, "x y z"], nodes: Int[np.ndarray, "nodes 3"]
) -> Float32[np.ndarray, "nodes 3"]:
    """Central differences at nodes that are not on the border, per two nodes."""
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
    """Depth along the normal at which all that can be seen has been seen.

    That is where the optical depth reaches `OPAQUE_OPTICAL_DEPTH`, or 99.9 % of all there is within
    `DEEPEST_M`; and `MARGIN_M`.
    """
    step = np.float32(0.5 * grid.voxel_m)
    ends = visible_depth_steps(
        grid.density, grid.low, np.float32(grid.voxel_m), positions, normals, step,
        int(MAX_THICKNESS_M / step), OPAQUE_OPTICAL_DEPTH, 0.999,
    )  # fmt: skip
    return ((ends + 1) * step + THICKNESS_MARGIN_M).astype(np.float32)

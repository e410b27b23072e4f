"""The proxy surface: a level set just outside the visible density, with normals and thickness."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int
from scipy import ndimage

from export.bake.bake_kernels import visible_depth_steps
from export.bake.field_grid import FieldGrid
from export.bake.grid_filters import remove_floaters_and_cavities, resample_grid

DENSITY_CONTRAST = 16.0
"""Factor about the level to which densities are clipped, as emptiness has no logarithm."""
SMOOTHING_M = 0.004
"""Standard deviation of the blur before the level set is extracted, metres."""
MIN_PART_FRACTION = 0.0002
"""Least volume of a part as a fraction of the largest one's; smaller ones are floaters. At ten
times this, a foot that few photographs had left in fragments was lost."""
OPAQUE_OPTICAL_DEPTH = 7.0
"""Optical depth behind which nothing is visible (0.1 %)."""
THICKNESS_MARGIN_M = 0.004
"""Added to the thickness, metres, for what lies deeper beside the normal than along it."""
MAX_THICKNESS_M = 0.1
"""Depth under the surface beyond which density is ignored, metres."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ProxySurface:
    """Points, normals and visible depth of a person's surface in canonical space.

    Attributes:
        spacing_m: Cell of the grid on which the level set was extracted, metres.
        positions: Metres.
        normals: Outward, of length 1.
        thickness: Depth along the inward normal to which the field is visible, metres.
    """

    spacing_m: float
    positions: Float32[np.ndarray, "surfels 3"]
    normals: Float32[np.ndarray, "surfels 3"]
    thickness: Float32[np.ndarray, "surfels"]


def extract_proxy_surface(grid: FieldGrid, *, level: float, spacing_m: float) -> ProxySurface:
    """Extract the outer level set of the blurred log-density, without floaters and cavities.

    Args:
        grid: The field.
        level: Density in 1/m. A lower one lets invisible haze shape the surface; a higher one cuts
            into the visible field.
        spacing_m: Cell of the grid on which it is extracted, metres; surfels lie on cell edges.
    """
    logs = resample_grid(_log_density(grid, level), spacing_m / grid.voxel_m)
    logs = ndimage.gaussian_filter(logs, SMOOTHING_M / spacing_m, truncate=3.0)
    inside = remove_floaters_and_cavities(logs > 0.0, MIN_PART_FRACTION)
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
    """Return the zero crossings of grid edges, in nodes, and unit normals.

    Args:
        logs: Positive inside.
        smoothed: A smoother version, from which normals are taken.
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

    That is where the optical depth along the inward normal reaches `OPAQUE_OPTICAL_DEPTH` or 99.9 %
    of its value at `MAX_THICKNESS_M`.
    """
    step = np.float32(0.5 * grid.voxel_m)
    ends = visible_depth_steps(
        grid.density, grid.low, np.float32(grid.voxel_m), positions, normals, step,
        int(MAX_THICKNESS_M / step), OPAQUE_OPTICAL_DEPTH, 0.999,
    )  # fmt: skip
    return ((ends + 1) * step + THICKNESS_MARGIN_M).astype(np.float32)

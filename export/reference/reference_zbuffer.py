"""The z-buffer of surfels in numpy, whose keys are a depth code and the number of a surfel."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int64

from export.package.player_tables import DEPTH_CODES, SURFEL_BITS, SURFEL_MASK, PlayerTables
from export.package.render_settings import RenderSettings

EMPTY_PIXEL_KEY = 2**31 - 1
"""Z-buffer key of a pixel that no surfel covers."""


class SurfelFootprints(NamedTuple):
    """Surfels' footprints, one row for each cell that one covers.

    Attributes:
        side: Edge of a footprint, pixels.
        cell: Cells, numbered in a picture with a margin of `side` pixels.
        key: Z-buffer keys.
        depth: Depths of surfels that may form a further layer, metres; 0 for the others.
    """

    side: int
    cell: Int64[np.ndarray, "splats"]
    key: Int64[np.ndarray, "splats"]
    depth: Float32[np.ndarray, "splats"]


def surfel_of_key(key: Int64[np.ndarray, "*pixels"]) -> Int64[np.ndarray, "*pixels"]:
    """Return the number of a key's surfel."""
    return key & SURFEL_MASK


def z_buffer(
    size_px: tuple[int, int],
    splats: SurfelFootprints,
    chosen: Bool[np.ndarray, "splats"] | None = None,
) -> Int64[np.ndarray, "rows columns"]:
    """Return the least key of every cell, of some splats or of all."""
    (width, height), margin = size_px, 2 * splats.side
    buffer = np.full((height + margin, width + margin), EMPTY_PIXEL_KEY, dtype=np.int64)
    where = slice(None) if chosen is None else chosen
    np.minimum.at(buffer.reshape(-1), splats.cell[where], splats.key[where])
    return buffer


def fill_holes(
    keys: Int64[np.ndarray, "rows columns"],
    tables: PlayerTables,
    settings: RenderSettings,
    side: int,
) -> Int64[np.ndarray, "height width"]:
    """Fill pixels that two opposite ones, a footprint away, overtop by far; cut off the margin."""
    here = slice(side, -side)
    across = np.maximum(keys[here, : -2 * side], keys[here, 2 * side :])
    along = np.maximum(keys[: -2 * side, here], keys[2 * side :, here])
    neighbors, keys = np.minimum(across, along), keys[here, here]
    steps = int(settings.hole_depth_m / (2.0 * tables.reach_m) * DEPTH_CODES)
    return np.where(keys - (steps << SURFEL_BITS) > neighbors, neighbors, keys)

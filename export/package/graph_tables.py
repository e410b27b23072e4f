"""The stored tables expanded for drawing: skinning nodes, and initializers of the graph."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float32, Int, Int32, Shaped

from capture.input_error import InputError
from export.package.player_tables import BRICK_NODES, PlayerTables, SkinningGrid
from export.package.render_settings import RenderSettings

UNSTORED_M = 1e6
"""Canonical coordinates of nodes that are not stored, metres. They make the Jacobian so large that
it is never inverted: outside the stored cells a ray keeps its direction."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinningNodes:
    """Nodes of the skinning grid at its own step, or at half of it.

    Linear blend skinning, Σ w_j(x) B_j x, poses each node; positions in between are interpolated.
    At half the grid's step that is within some tenths of a millimetre of skinning itself.

    Attributes:
        low: Corner of the grid, canonical metres.
        step_m: Distance between nodes along x, y, z, metres.
        index: Row of each node, 0 where it or the next node along z is not stored. Rows are
            numbered in C order, so that the next row is the next node along z; one more row than
            there are nodes follows the last.
        positions: Canonical metres; `UNSTORED_M` in the first and the last row, which are no nodes.
        weights: Joints' weights, one column a row of `positions`.
    """

    low: Float32[np.ndarray, "3"]
    step_m: Float32[np.ndarray, "3"]
    index: Int32[np.ndarray, "x y z"]
    positions: Float32[np.ndarray, "rows 3"]
    weights: Float32[np.ndarray, "24 rows"]


def skinning_nodes(skin: SkinningGrid, subdivision: int) -> SkinningNodes:
    """Return the nodes of a skinning grid.

    Args:
        skin: The stored grid.
        subdivision: Parts into which each step is cut, 1 or 2.

    Raises:
        InputError: If it is neither.
    """
    if subdivision not in (1, 2):
        raise InputError(
            f"The package cuts steps of its skinning grid into {subdivision} parts; expected 1 or "
            "2. The file is damaged, or another program wrote it."
        )
    return subdivided_skinning_nodes(skin) if subdivision == 2 else stored_skinning_nodes(skin)


@lru_cache(maxsize=1)
def stored_skinning_nodes(skin: SkinningGrid) -> SkinningNodes:
    """Return every stored node."""
    place = np.argwhere(skin.index > 0)
    weights = np.zeros((24, len(place) + 2), dtype=np.float32)
    weights[:, :-1] = skin.weights.T
    weights[0, -1] = 1.0
    return SkinningNodes(
        low=skin.low,
        step_m=skin.step_m,
        index=_rows_with_next_in_z(skin.index),
        positions=_padded_positions(place, skin.low, skin.step_m),
        weights=weights,
    )


@lru_cache(maxsize=1)
def subdivided_skinning_nodes(skin: SkinningGrid) -> SkinningNodes:
    """Return every node at half the step in cells whose eight corners are stored."""
    inside = _nodes_of_complete_cells(skin.index > 0)
    place = np.argwhere(inside)
    index = np.zeros(inside.shape, dtype=np.int32)
    index[inside] = np.arange(1, len(place) + 1)
    coarse, odd = place >> 1, place & 1
    codes = np.ascontiguousarray(skin.weight_codes.T)
    weights = np.zeros((24, len(place) + 2), dtype=np.float32)
    weights[0, [0, -1]] = 1.0
    for parity in np.ndindex(2, 2, 2):  # a node between others takes their mean
        chosen = np.flatnonzero((odd == parity).all(axis=1))
        corners = [c for c in np.ndindex(2, 2, 2) if all(np.less_equal(c, parity))]
        total = np.zeros((len(chosen), 24), dtype=np.uint32)
        for corner in corners:
            total += codes[skin.index[tuple((coarse[chosen] + corner).T)]]
        sums = total.sum(axis=1, keepdims=True, dtype=np.float32)
        weights[:, chosen + 1] = (total / np.maximum(sums, np.float32(1.0))).T
    step_m = skin.step_m * np.float32(0.5)
    return SkinningNodes(
        low=skin.low,
        step_m=step_m,
        index=_rows_with_next_in_z(index),
        positions=_padded_positions(place, skin.low, step_m),
        weights=weights,
    )


def _rows_with_next_in_z(index: Int32[np.ndarray, "x y z"]) -> Int32[np.ndarray, "x y z"]:
    """Set the rows of nodes to 0 whose next node along z is not stored."""
    kept = np.zeros_like(index)
    kept[..., :-1] = np.where(index[..., 1:] > 0, index[..., :-1], 0)
    return kept


def _padded_positions(
    place: Int[np.ndarray, "nodes 3"],
    low: Float32[np.ndarray, "3"],
    step_m: Float32[np.ndarray, "3"],
) -> Float32[np.ndarray, "rows 3"]:
    """Return positions of nodes, with a row of `UNSTORED_M` before and after them."""
    positions = (place * step_m + low).astype(np.float32)
    return np.pad(positions, [(1, 1), (0, 0)], constant_values=UNSTORED_M)


def _nodes_of_complete_cells(stored: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "fx fy fz"]:
    """Mark the nodes at half the step in cells whose corners are all stored."""
    nx, ny, nz = stored.shape
    whole = np.ones((nx - 1, ny - 1, nz - 1), dtype=bool)
    for i, j, k in np.ndindex(2, 2, 2):
        whole &= stored[i : nx - 1 + i, j : ny - 1 + j, k : nz - 1 + k]
    inside = np.zeros((2 * nx - 1, 2 * ny - 1, 2 * nz - 1), dtype=bool)
    for i, j, k in np.ndindex(3, 3, 3):
        inside[i : i + 2 * nx - 2 : 2, j : j + 2 * ny - 2 : 2, k : k + 2 * nz - 2 : 2] |= whole
    return inside


def graph_initializers(
    tables: PlayerTables, settings: RenderSettings
) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Return the tables of a graph with these settings by name, one-dimensional where possible."""
    surfels, bricks = tables.surfels, tables.bricks
    nodes = skinning_nodes(tables.skinning, settings.skinning_subdivision)
    voxels = bricks.voxels.reshape(-1, 4)
    red, green, blue = (voxels[:, channel].astype(np.int32) for channel in range(3))
    columns = {
        "voxel_color": red | green << 8 | blue << 16,
        "voxel_density": np.ascontiguousarray(voxels[:, 3]),
        "brick_offset": bricks.index.ravel() * np.int32(BRICK_NODES**3),
        "node": nodes.index.ravel(),
        "node_weights": nodes.weights,
        "thickness": surfels.thickness,
    }
    for axis, letter in enumerate("xyz"):
        columns[f"node_{letter}"] = np.ascontiguousarray(nodes.positions[:, axis])
        columns[f"position_{letter}"] = np.ascontiguousarray(surfels.positions[:, axis])
        columns[f"normal_{letter}"] = np.ascontiguousarray(surfels.normals[:, axis])
    return columns

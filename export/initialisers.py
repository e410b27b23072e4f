"""The tables as the graph reads them: one-dimensional columns, two channels to an integer."""

import numpy as np
from jaxtyping import Shaped

from export.skin import finer_nodes
from export.tables import NODES, Tables


def initialisers(tables: Tables) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Every table of the graph by its name."""
    surfels, bricks, nodes = tables.surfels, tables.bricks, finer_nodes(tables.skin)
    voxels = bricks.voxels.reshape(-1, 4).astype(np.int32)
    columns = {
        "voxel_red_blue": voxels[:, 0] | voxels[:, 2] << 16,
        "voxel_green_density": voxels[:, 1] | voxels[:, 3] << 16,
        "brick_offset": bricks.index.ravel() * np.int32(NODES**3),
        "node": nodes.index.ravel(),
        "node_weights": nodes.weights,
        "thickness": surfels.thickness,
        "surfel": np.arange(len(surfels), dtype=np.int32),
    }
    for axis, letter in enumerate("xyz"):
        columns[f"node_{letter}"] = np.ascontiguousarray(nodes.positions[:, axis])
        columns[f"position_{letter}"] = np.ascontiguousarray(surfels.positions[:, axis])
        columns[f"normal_{letter}"] = np.ascontiguousarray(surfels.normals[:, axis])
    return columns

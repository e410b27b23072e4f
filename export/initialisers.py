"""The tables as the graph reads them: one-dimensional columns."""

import numpy as np
from jaxtyping import Shaped

from export.rules import RenderSettings
from export.skin import skinning_nodes
from export.tables import BRICK_NODES, PlayerTables


def graph_initializers(tables: PlayerTables, rules: RenderSettings) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Every table of the graph that draws by these rules, by its name."""
    surfels, bricks = tables.surfels, tables.bricks
    nodes = skinning_nodes(tables.skinning, rules.skinning_subdivision)
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

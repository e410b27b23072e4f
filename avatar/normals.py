"""Which way the skin looks: unit outward normals at its vertices, and each one's share of it."""

import numpy as np
from jaxtyping import Float, Int


def vertex_normals(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> tuple[Float[np.ndarray, "vertices 3"], Float[np.ndarray, "vertices"]]:
    """Outward unit normals, and each vertex's share of the surface in square metres."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    doubled = np.cross(b - a, c - a)
    normals, areas = np.zeros_like(vertices), np.zeros(len(vertices))
    for k in range(3):
        np.add.at(normals, faces[:, k], doubled)
        np.add.at(areas, faces[:, k], np.linalg.norm(doubled, axis=1) / 6.0)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return normals, areas

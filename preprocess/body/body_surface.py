"""The surface of a triangle mesh: vertex normals, vertex areas and visible points."""

import numpy as np
from jaxtyping import Bool, Float, Int


def vertex_normals(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "vertices 3"]:
    """Outward unit normals, area-weighted over the triangles around each vertex."""
    doubled, corners = _doubled_area_vectors(vertices, faces), faces.ravel()
    normals = np.column_stack(
        [
            np.bincount(corners, np.repeat(doubled[:, axis], 3), minlength=len(vertices))
            for axis in range(3)
        ]
    )
    return normals / (np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12)


def vertex_areas(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "vertices"]:
    """Each vertex's share of the surface, m²: a third of every triangle around it."""
    thirds = np.linalg.norm(_doubled_area_vectors(vertices, faces), axis=1) / 6.0
    return np.bincount(faces.ravel(), np.repeat(thirds, 3), minlength=len(vertices))


def _doubled_area_vectors(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "faces 3"]:
    """Normal of each triangle, twice its area long."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def visible_points(
    image_points: Float[np.ndarray, "points 2"],
    depth: Float[np.ndarray, "points"],
    cosine: Float[np.ndarray, "points"],
    *,
    cell_m: float,
    tolerance_m: float,
) -> Bool[np.ndarray, "points"]:
    """Which points face the camera unoccluded, by a depth buffer of coarse cells.

    Args:
        image_points: Image coordinates, scaled to metres at the body.
        depth: Distance from the camera along its axis, metres.
        cosine: Of the angle between a point's normal and the direction to the camera. Points that
            face away occlude nothing.
        cell_m: Edge of a cell: no less than the points' spacing.
        tolerance_m: How far a point may lie behind the nearest of its cell, beyond its own slope.
    """
    cell = np.floor((image_points - image_points.min(axis=0)) / cell_m).astype(np.int64)
    columns = int(cell[:, 1].max()) + 1
    flat = cell[:, 0] * columns + cell[:, 1]
    nearest = np.full(int(flat.max()) + 1, np.inf)
    faces = cosine > 0.0
    np.minimum.at(nearest, flat[faces], depth[faces])
    steep = np.clip(cosine, 0.1, 1.0)
    slope = cell_m * np.sqrt(1.0 - steep**2) / steep
    return faces & (depth <= nearest[flat] + tolerance_m + slope)

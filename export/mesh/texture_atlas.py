"""A texture for a mesh of few triangles: each has half of a square cell of the image to itself."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32, UInt8

TEXEL_M = 0.002
"""Edge of a texel on the surface, about, metres: as fine as the bricks' voxels."""
MIN_CELL_PX, MAX_SIDE_PX = 6, 4096
"""Least side of a cell, and largest side of the image, px."""
MARGIN_PX = 3.5
"""Texels of a cell's side that are beyond a triangle, so that filters mix no other's colors in."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Texture:
    """A texture and where its mesh's vertices lie in it; no two triangles share a vertex.

    Attributes:
        image: sRGB, the first row at the top.
        coordinates: Of each vertex, in [0, 1] from the image's upper left corner.
    """

    image: UInt8[np.ndarray, "rows columns 3"]
    coordinates: Float32[np.ndarray, "vertices 2"]


def make_texture(
    positions: Float32[np.ndarray, "vertices 3"],
    normals: Float32[np.ndarray, "vertices 3"],
    faces: Int32[np.ndarray, "faces 3"],
    color_at: Callable[
        [Float32[np.ndarray, "points 3"], Float32[np.ndarray, "points 3"]],
        UInt8[np.ndarray, "points 3"],
    ],
) -> Texture:
    """Draw the texture of a mesh.

    Args:
        positions: Of the vertices, metres.
        normals: Of the vertices.
        faces: Triangles; the texture's vertices are their corners, in order.
        color_at: Colors of points on the surface, by their positions and normals.
    """
    columns = int(np.ceil(np.sqrt(np.ceil(len(faces) / 2))))
    corners = positions[faces]
    edge_m = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
    side = int(np.clip(edge_m / TEXEL_M + MARGIN_PX, MIN_CELL_PX, max(8, MAX_SIDE_PX // columns)))
    row, column = np.mgrid[:side, :side].reshape(2, -1) + 0.5
    upper = row + column > side  # of the two triangles of a cell
    first, leg = 1.0, side - MARGIN_PX
    a = np.where(upper, side - column - first, column - first) / leg
    b = np.where(upper, side - row - first, row - first) / leg
    shares = np.stack([1.0 - a - b, a, b], axis=1).astype(np.float32)
    image = np.zeros((columns, side, columns, side, 3), dtype=np.uint8)
    for half, inside in enumerate((~upper, upper)):
        own = faces[half::2]
        points, directions = (
            np.einsum("tc,fcx->ftx", shares[inside], each[own]).reshape(-1, 3)
            for each in (positions, normals)
        )
        directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-6)
        drawn = color_at(points, directions).reshape(len(own), -1, 3)
        cell_row, cell_column = np.divmod(np.arange(len(own)), columns)
        at_row, at_column = (np.floor(each[inside]).astype(int) for each in (row, column))
        image[cell_row[:, None], at_row, cell_column[:, None], at_column] = drawn
    return Texture(
        image=image.reshape(columns * side, columns * side, 3),
        coordinates=_coordinates(len(faces), columns, side),
    )


def _coordinates(faces: int, columns: int, side: int) -> Float32[np.ndarray, "vertices 2"]:
    """Where the corners of all triangles lie in the image."""
    leg = side - MARGIN_PX
    lower = np.array([[1.0, 1.0], [1.0 + leg, 1.0], [1.0, 1.0 + leg]])
    both = np.stack([lower, side - lower])[np.arange(faces) % 2]
    cell_row, cell_column = np.divmod(np.arange(faces) // 2, columns)
    corner = np.stack([cell_column, cell_row], axis=1) * side
    placed = (both + corner[:, None]) / (columns * side)
    return placed.reshape(-1, 2).astype(np.float32)

"""Texture of a mesh: charts that xatlas unwraps, with gutters of their own colors between them.

A texture filter reads texels beside a chart's border, and a mipmap averages over several; both read
the chart's own colors as far as `GUTTER_PX`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, Int32, UInt8

TEXEL_M = 0.002
"""Edge of a texel on the surface, about, metres: as fine as the bricks' voxels."""
MIN_SIDE_PX, MAX_SIDE_PX = 128, 4096
"""Least and largest side of the image, px; a power of two, from which any engine makes mipmaps."""
FILLED_SHARE = 0.6
"""Share of the image that charts cover, about."""
GUTTER_PX = 12
"""Distance of two charts when they are packed, px; about 8 in the image, where the charts of the
first three mipmaps do not mix."""
SUBPIXEL_BITS = 8
"""Bits of a corner's place within a texel when triangles are drawn."""
ColorAt = Callable[
    [Float32[np.ndarray, "points 3"], Float32[np.ndarray, "points 3"]],
    UInt8[np.ndarray, "points 3"],
]
"""Returns the colors of points on the surface, from their normals."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Texture:
    """A texture and where its mesh's vertices lie in it.

    Attributes:
        image: sRGB, the first row at the top.
        coordinates: Of each vertex, in [0, 1] from the image's upper left corner.
    """

    image: UInt8[np.ndarray, "rows columns 3"]
    coordinates: Float32[np.ndarray, "vertices 2"]


@dataclass(frozen=True, eq=False, kw_only=True)
class UnwrappedMesh:
    """A mesh whose vertices at the borders of charts are doubled.

    Attributes:
        sources: Vertex of the given mesh that each vertex is a copy of.
        faces: Of the new vertices, in the given order.
        coordinates: Of each vertex in a texture of `side_px` texels.
    """

    sources: Int32[np.ndarray, "vertices"]
    faces: Int32[np.ndarray, "faces 3"]
    coordinates: Float32[np.ndarray, "vertices 2"]
    side_px: int


def unwrap(
    positions: Float32[np.ndarray, "given 3"], faces: Int32[np.ndarray, "faces 3"]
) -> UnwrappedMesh:
    """Cut a surface into charts and place them in a square, about `TEXEL_M` to a texel."""
    import xatlas  # not needed by the player

    a, b, c = (positions[corner] for corner in faces.T)
    area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    fine_px = np.sqrt(area / FILLED_SHARE) / TEXEL_M
    side_px = int(np.clip(2 ** np.round(np.log2(fine_px)), MIN_SIDE_PX, MAX_SIDE_PX))
    atlas, packing = xatlas.Atlas(), xatlas.PackOptions()
    packing.padding, packing.resolution = GUTTER_PX, side_px
    atlas.add_mesh(positions, faces.astype(np.uint32))
    atlas.generate(xatlas.ChartOptions(), packing)
    sources, corners, coordinates = atlas[0]
    return UnwrappedMesh(
        sources=sources.astype(np.int32),
        faces=corners.astype(np.int32),
        coordinates=coordinates.astype(np.float32),
        side_px=side_px,
    )


def draw_texture(
    mesh: UnwrappedMesh,
    positions: Float32[np.ndarray, "vertices 3"],
    normals: Float32[np.ndarray, "vertices 3"],
    color_at: ColorAt,
) -> Texture:
    """Draw the texture of an unwrapped mesh from the colors of its surface."""
    places = mesh.coordinates * np.float32(mesh.side_px) - np.float32(0.5)
    face_at = _draw_faces(places[mesh.faces], mesh.side_px)
    rows, columns = np.nonzero(face_at >= 0)
    corners = mesh.faces[face_at[rows, columns]]
    shares = _shares_of_corners(np.stack([columns, rows], axis=1), places[corners])
    points, directions = (
        np.einsum("tc,tcx->tx", shares, each[corners]).astype(np.float32)
        for each in (positions, normals)
    )
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-6)
    image = np.zeros((mesh.side_px, mesh.side_px, 3), dtype=np.uint8)
    image[rows, columns] = color_at(points, directions)
    # single texels may see a voxel that no picture shows: in small concave places, lips and eyelids
    image = cv2.medianBlur(_fill_gutters(image, face_at >= 0), 3)
    return Texture(image=image, coordinates=mesh.coordinates)


def _draw_faces(
    corners: Float32[np.ndarray, "faces 3 2"], side_px: int
) -> Int32[np.ndarray, "side side"]:
    """Return the face at each texel, borders included; -1 where there is none."""
    face_at = np.full((side_px, side_px), -1, dtype=np.int32)
    for face, corner in enumerate(np.round(corners * 2**SUBPIXEL_BITS).astype(np.int32)):
        cv2.fillConvexPoly(face_at, corner, (face,), shift=SUBPIXEL_BITS)
    return face_at


def _shares_of_corners(
    places: Int[np.ndarray, "texels 2"], corners: Float32[np.ndarray, "texels 3 2"]
) -> Float32[np.ndarray, "texels 3"]:
    """Return barycentric coordinates, of the nearest point of the triangle or about that."""
    edges = corners[:, 1:] - corners[:, :1]
    away = places - corners[:, 0]
    double_area = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    double_area = np.where(np.abs(double_area) < 1e-6, np.inf, double_area)
    b = (away[:, 0] * edges[:, 1, 1] - away[:, 1] * edges[:, 1, 0]) / double_area
    c = (edges[:, 0, 0] * away[:, 1] - edges[:, 0, 1] * away[:, 0]) / double_area
    shares = np.clip(np.stack([1.0 - b - c, b, c], axis=1), 0.0, 1.0)
    return (shares / shares.sum(axis=1, keepdims=True)).astype(np.float32)


def _fill_gutters(
    image: UInt8[np.ndarray, "rows columns 3"], is_drawn: Bool[np.ndarray, "rows columns"]
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Give each texel outside of the charts the color of the nearest one within."""
    _, labels = cv2.distanceTransformWithLabels(
        (~is_drawn).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = labels.astype(np.intp)
    colors = np.zeros((int(nearest.max()) + 1, 3), dtype=np.uint8)
    colors[nearest[is_drawn]] = image[is_drawn]
    return colors[nearest]

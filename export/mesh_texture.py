"""Texture of a mesh: charts that xatlas unwraps, with gutters of their own colors between them.

A texture filter reads texels beside a chart's border, and a mipmap averages over several; both read
the chart's own colors as far as a gutter. Colors along the surface's normals miss what is seen
from aside (folds, a brow, fog), so pictures of the avatar from around it correct them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8

from capture.camera import Camera
from export.splat_colors import cameras_around

TEXEL_M = 0.002
"""Edge of a texel on the surface, about, metres: as fine as the bricks' voxels."""
MIN_SIDE_PX, MAX_SIDE_PX = 128, 4096
"""Least and largest side of the image, px; a power of two, from which any engine makes mipmaps."""
SUBPIXEL_BITS = 8
"""Bits of a corner's place within a texel when triangles are drawn."""
VIEWS = 16
"""Pictures of the avatar that correct a texture."""
PIXEL_M = 0.003
"""Size of their pixels on the avatar, about, metres."""
OWN_WEIGHT = 0.1
"""Weight of a texel's color along its normal, in pictures that see it squarely."""
ColorAt = Callable[
    [Float32[np.ndarray, "points 3"], Float32[np.ndarray, "points 3"]],
    UInt8[np.ndarray, "points 3"],
]
"""Returns the colors of points on the surface, from their normals."""
PictureBy = Callable[[Camera], UInt8[np.ndarray, "height width 4"]]
"""Returns a picture of the avatar in its canonical pose, with straight alpha."""


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
    fine_px = np.sqrt(area / 0.6) / TEXEL_M  # charts cover about this much
    side_px = int(np.clip(2 ** np.round(np.log2(fine_px)), MIN_SIDE_PX, MAX_SIDE_PX))
    atlas, packing = xatlas.Atlas(), xatlas.PackOptions()
    # about 8 in the image, where charts of the first three mipmaps do not mix
    packing.padding, packing.resolution = 12, side_px
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
    picture_by: PictureBy,
) -> Texture:
    """Draw the texture of an unwrapped mesh from the colors of its surface and from pictures."""
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
    coarse = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.75)  # as coarse as these pictures
    total = np.zeros((len(points), 3), dtype=np.float32)
    weight = np.full((len(points), 1), OWN_WEIGHT, dtype=np.float32)
    for camera in cameras_around(positions, views=VIEWS, pixel_m=PIXEL_M):
        seen, cosines, missing = _missing_colors(
            camera, picture_by(camera), positions, mesh.faces, places, coarse, points, directions
        )
        total[seen] += cosines * missing
        weight[seen] += cosines
    better = image[rows, columns] + total / weight
    image[rows, columns] = np.clip(np.round(better), 0, 255).astype(np.uint8)
    return Texture(image=_fill_gutters(image, face_at >= 0), coordinates=mesh.coordinates)


def _missing_colors(
    camera: Camera,
    picture: UInt8[np.ndarray, "height width 4"],
    positions: Float32[np.ndarray, "vertices 3"],
    faces: Int32[np.ndarray, "faces 3"],
    places: Float32[np.ndarray, "vertices 2"],
    coarse: Float32[np.ndarray, "rows columns 3"],
    points: Float32[np.ndarray, "texels 3"],
    directions: Float32[np.ndarray, "texels 3"],
) -> tuple[Int[np.ndarray, "seen"], Float32[np.ndarray, "seen 1"], Float32[np.ndarray, "seen 3"]]:
    """Compare a picture with the mesh, drawn by the same camera.

    `places` are the vertices' in the texture `coarse`, texels. Returns the texels that are seen,
    the cosine between view and normal, and what the picture has more.
    """
    pixels, depths = _project(camera, positions)
    faces = faces[np.argsort(-depths[faces].sum(axis=1))]  # nearer ones are drawn over farther ones
    face_at = _draw_faces(pixels[faces], len(picture))
    y, x = np.nonzero((face_at >= 0) & (picture[..., 3] > 127))
    corners = faces[face_at[y, x]]
    shares = _shares_of_corners(np.stack([x, y], axis=1), pixels[corners])
    more = np.zeros((*picture.shape[:2], 3), dtype=np.float32)
    more[y, x] = picture[y, x, :3] - _sample(
        coarse, np.einsum("pc,pcx->px", shares, places[corners])
    )
    nearest = np.full(picture.shape[:2], -np.inf)
    nearest[y, x] = (shares * depths[corners]).sum(axis=1)
    centers, away = _project(camera, points)
    towards = camera.center_world - points
    cosines = (towards * directions).sum(axis=1) / np.linalg.norm(towards, axis=1)
    column, row = np.round(centers).astype(int).T
    seen = np.flatnonzero((cosines > 0.2) & (away < nearest[row, column] + 0.006))
    return seen, cosines[seen, None].astype(np.float32), _sample(more, centers[seen])


def _project(
    camera: Camera, points: Float32[np.ndarray, "points 3"]
) -> tuple[Float32[np.ndarray, "points 2"], Float[np.ndarray, "points"]]:
    """Return where points are seen, px from the center of the first pixel, and their depths."""
    depths = points @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
    return (camera.project(points) - 0.5).astype(np.float32), depths


def _sample(
    image: Float32[np.ndarray, "rows columns 3"], places: Float[np.ndarray, "points 2"]
) -> Float32[np.ndarray, "points 3"]:
    """Read an image between pixels, bilinearly."""
    shape = len(places) // 1024 + 1, 1024  # OpenCV takes at most 32,767 rows
    x, y = (np.resize(each, shape).astype(np.float32) for each in places.T)
    return cv2.remap(image, x, y, cv2.INTER_LINEAR).reshape(-1, 3)[: len(places)]


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

"""A package's avatar as a mesh that other programs move: vertices, colors, skinning weights."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.spatial import KDTree

from export.mesh.isosurface import extract_isosurface, resample_grid
from export.package.player_tables import BRICK_SIZE, LOG_DENSITY_RANGE, BrickTable, PlayerTables

VERTEX_SPACING_M = 0.005
"""Edge of the cells that the surface is taken on; each crossed cell becomes a vertex."""
SURFACE_DENSITY, HAZE_DENSITY = 50.0, 15.0
"""Density of the surface, and of the faint cover that must close what no camera saw, 1/m."""
BORDER_VOXELS = 4
"""Empty voxels all round, so that closing and blurring do not meet the end."""
CLOSING_VOXELS, SOLID_DEPTH_VOXELS = 2, 3
"""Voxels: holes of twice the first are closed in that cover, and what is deeper under it than the
second is solid, whatever the bricks say: they hold only what can be seen."""
BLUR_VOXELS, CODE_CONTRAST = 0.75, 40.0
"""Deviation of the blur in voxels, and the codes above and below the level that count."""
MIN_VOLUME_FRACTION = 0.002
"""Parts of less volume than this share of the largest are floaters."""
NORMAL_SMOOTHINGS = 6
"""How often normals are averaged over neighbours: a trained field is never quite smooth."""
COLOR_STEP_M, COLOR_DEPTH_M = 0.002, 0.03
"""A vertex has the color of a ray that enters there: its steps, and how deep it goes."""
COLOR_LEAD_M = 0.004
"""How far outside of the surface that ray begins."""
MIN_COLOR_ALPHA = 0.2
"""Alpha below which a vertex has no color of its own but its neighbour's."""
JOINTS_PER_VERTEX = 4
"""Joints that move a vertex: what importers can be relied on to read."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinnedMesh:
    """A closed mesh in the canonical pose.

    Attributes:
        positions: Canonical metres.
        normals: Outward, of length 1.
        colors: sRGB.
        faces: Anticlockwise seen from outside.
        joints: Which joints move each vertex; those without weight are 0.
        weights: How much, × 255; each row sums to 255.
    """

    positions: Float32[np.ndarray, "vertices 3"]
    normals: Float32[np.ndarray, "vertices 3"]
    colors: UInt8[np.ndarray, "vertices 3"]
    faces: Int32[np.ndarray, "faces 3"]
    joints: UInt8[np.ndarray, "vertices 4"]
    weights: UInt8[np.ndarray, "vertices 4"]


def extract_mesh(tables: PlayerTables, *, spacing_m: float = VERTEX_SPACING_M) -> SkinnedMesh:
    """The surface of a bake.

    Args:
        tables: The bake.
        spacing_m: About how far vertices lie apart.
    """
    codes, low = _dense_grid(tables.bricks)
    voxel_m = tables.bricks.voxel_m
    step = spacing_m / voxel_m
    nodes, faces = extract_isosurface(resample_grid(_level_function(codes[..., 3]), step))
    nodes *= np.float32(step)
    positions = (low + nodes * np.float32(voxel_m)).astype(np.float32)
    normals = _smooth_normals(positions, faces)
    joints, weights = _strongest_joints(skinning_weights(tables, positions))
    return SkinnedMesh(
        positions=positions,
        normals=normals,
        colors=_vertex_colors(codes, nodes, normals, voxel_m),
        faces=faces,
        joints=joints,
        weights=weights,
    )


def _level_function(density: UInt8[np.ndarray, "x y z"]) -> Float32[np.ndarray, "x y z"]:
    """Positive inside: log-density above the level, smoothed, without floaters and hollows."""
    level = _density_code(SURFACE_DENSITY)
    solid = _remove_floaters(
        (density > level) | _solid_interior(density > _density_code(HAZE_DENSITY))
    )
    height = density.astype(np.float32) - level
    height = np.where(solid, np.maximum(height, 1.0), np.minimum(height, -1.0))
    return ndimage.gaussian_filter(
        np.clip(height, -CODE_CONTRAST, CODE_CONTRAST), BLUR_VOXELS, truncate=3.0
    )


def _density_code(density: float) -> np.float32:
    """The 8-bit code of a density, not rounded."""
    begin, end = LOG_DENSITY_RANGE
    return np.float32((np.log(density) - begin) / (end - begin) * 255.0)


def _solid_interior(cover: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """What lies well below a cover with holes."""
    closed = ndimage.binary_closing(cover, iterations=CLOSING_VOXELS)
    filled = ndimage.binary_fill_holes(closed)
    return np.asarray(ndimage.binary_erosion(filled, iterations=SOLID_DEPTH_VOXELS))


def skinning_weights(
    tables: PlayerTables, points: Float32[np.ndarray, "points 3"]
) -> Float32[np.ndarray, "points 24"]:
    """Weights of the joints at points near the surface; rows sum to 1.

    Trilinear between the skin's nodes; where none is stored about a point, the nearest one's.
    """
    skin = tables.skinning
    place = np.clip((points - skin.low) / skin.step_m, 0.0, np.array(skin.index.shape) - 1.001)
    base = np.floor(place).astype(np.int64)
    total = np.zeros((len(points), 24), dtype=np.float32)
    for corner in np.ndindex(2, 2, 2):
        share = np.abs(1 - np.array(corner) - (place - base)).prod(axis=1)
        column = skin.index[tuple((base + corner).T)]
        total += skin.weights[column] * np.where(column > 0, share, 0.0)[:, None].astype(np.float32)
    alone = total.sum(axis=1) < 1e-3
    if alone.any():
        stored = np.argwhere(skin.index > 0)
        nearest = stored[KDTree(stored).query(place[alone])[1]]
        total[alone] = skin.weights[skin.index[tuple(nearest.T)]]
    return total / total.sum(axis=1, keepdims=True)


def _dense_grid(
    bricks: BrickTable,
) -> tuple[UInt8[np.ndarray, "x y z 4"], Float32[np.ndarray, "3"]]:
    """The grid round all bricks, with an empty border, and where its first node lies."""
    blocks = np.argwhere(bricks.index > 0)
    first, last = blocks.min(axis=0), blocks.max(axis=0)
    counts = (last - first + 1) * BRICK_SIZE
    codes = np.zeros((*(counts + 2 * BORDER_VOXELS), 4), dtype=np.uint8)
    cores = bricks.voxels[bricks.index[tuple(blocks.T)], :BRICK_SIZE, :BRICK_SIZE, :BRICK_SIZE]
    for corner, core in zip((blocks - first) * BRICK_SIZE + BORDER_VOXELS, cores, strict=True):
        codes[tuple(slice(c, c + BRICK_SIZE) for c in corner)] = core
    low = bricks.low + (first * BRICK_SIZE - BORDER_VOXELS) * bricks.voxel_m
    return codes, low.astype(np.float32)


def _remove_floaters(dense: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """Without floaters, and with what it encloses: bricks hold only what can be seen."""
    parts = np.zeros(dense.shape, dtype=np.int32)
    ndimage.label(dense, output=parts)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    kept = sizes >= MIN_VOLUME_FRACTION * sizes.max()
    return np.asarray(ndimage.binary_fill_holes(kept[parts]))


def _smooth_normals(
    positions: Float32[np.ndarray, "vertices 3"], faces: Int32[np.ndarray, "faces 3"]
) -> Float32[np.ndarray, "vertices 3"]:
    """Means of the faces' normals by their areas, evened out over neighbours."""
    count = len(positions)
    a, b, c = (positions[corner] for corner in faces.T)
    areas = np.cross(b - a, c - a)
    touches = coo_array(
        (np.ones(faces.size), (faces.ravel(), np.repeat(np.arange(len(faces)), 3))),
        shape=(count, len(faces)),
    ).tocsr()
    neighbours = touches @ touches.T
    normals = _normalize(touches @ areas)
    for _ in range(NORMAL_SMOOTHINGS):
        normals = _normalize(neighbours @ normals)
    return normals.astype(np.float32)


def _normalize(vectors: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "vertices 3"]:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    upward = np.array([0.0, 1.0, 0.0])  # where they cancel out
    return np.where(length > 1e-12, vectors / np.maximum(length, 1e-12), upward)


def _vertex_colors(
    codes: UInt8[np.ndarray, "x y z 4"],
    nodes: Float32[np.ndarray, "vertices 3"],
    normals: Float32[np.ndarray, "vertices 3"],
    voxel_m: float,
) -> UInt8[np.ndarray, "vertices 3"]:
    """What a ray along the normal sees from outside."""
    begin, end = LOG_DENSITY_RANGE
    total = np.zeros((len(nodes), 3), dtype=np.float32)
    passed = np.ones(len(nodes), dtype=np.float32)
    for depth in np.arange(-COLOR_LEAD_M, COLOR_DEPTH_M, COLOR_STEP_M):
        place = (nodes - normals * np.float32(depth / voxel_m)).T
        sampled = [
            ndimage.map_coordinates(codes[..., channel], place, np.float32, order=1)
            for channel in range(4)
        ]
        density = np.where(
            sampled[3] > 0.5, np.exp(sampled[3] * ((end - begin) / 255.0) + begin), 0.0
        )
        left = passed * np.exp(-density * COLOR_STEP_M).astype(np.float32)
        total += np.stack(sampled[:3], axis=1) * (passed - left)[:, None]
        passed = left
    opaque = 1.0 - passed
    colors = np.clip(np.round(total / np.maximum(opaque, 1e-3)[:, None]), 0, 255).astype(np.uint8)
    blank, known = opaque < MIN_COLOR_ALPHA, np.flatnonzero(opaque >= MIN_COLOR_ALPHA)
    if blank.any() and len(known):
        colors[blank] = colors[known[KDTree(nodes[known]).query(nodes[blank])[1]]]
    return colors


def _strongest_joints(
    weights: Float32[np.ndarray, "vertices 24"],
) -> tuple[UInt8[np.ndarray, "vertices 4"], UInt8[np.ndarray, "vertices 4"]]:
    """The strongest joints of each vertex, and their weights in whole 255ths."""
    joints = np.argsort(-weights, axis=1, kind="stable")[:, :JOINTS_PER_VERTEX]
    strongest = np.take_along_axis(weights, joints, axis=1).astype(np.float64)
    scaled = strongest / strongest.sum(axis=1, keepdims=True) * 255.0
    codes = np.floor(scaled).astype(np.int64)
    missing = 255 - codes.sum(axis=1, keepdims=True)
    rank = np.argsort(np.argsort(codes - scaled, axis=1, kind="stable"), axis=1)
    codes += rank < missing
    return np.where(codes > 0, joints, 0).astype(np.uint8), codes.astype(np.uint8)

"""A package's avatar as a mesh: vertices, colors or a texture, and skinning weights."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.spatial import KDTree

from export.bake.voxel_grid import (
    extract_isosurface,
    fill_cavities,
    remove_floaters_and_cavities,
    resample_grid,
)
from export.mesh_texture import PictureBy, Texture, draw_texture, unwrap
from export.package.player_tables import (
    BRICK_SIZE,
    BrickTable,
    PlayerTables,
    decode_density,
    density_code,
)

SURFACE_DENSITY = 20.0
"""Density of the surface, 1/m: the silhouette is then as wide as the renderer's (at 25 by 0.7 mm
thinner, measured on three avatars)."""
BORDER_VOXELS = 4
"""Empty voxels around the bricks, so that closing and blurring stay clear of the border."""
CODE_CONTRAST = 40.0
"""Density codes above and below the level to which densities are clipped."""
COLOR_STEP_M = 0.002
"""Step of the rays that give vertices their colors, metres."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinnedMesh:
    """A closed mesh in the canonical pose, metres.

    Attributes:
        normals: Outward, of length 1.
        colors: sRGB.
        faces: Counter-clockwise seen from outside.
        joints: Joints that move each vertex; 0 where the weight is 0.
        weights: Skinning weights × 255; each row sums to 255.
        texture: Finer colors than those of the vertices; None of a mesh of many triangles.
    """

    positions: Float32[np.ndarray, "vertices 3"]
    normals: Float32[np.ndarray, "vertices 3"]
    colors: UInt8[np.ndarray, "vertices 3"]
    faces: Int32[np.ndarray, "faces 3"]
    joints: UInt8[np.ndarray, "vertices 4"]
    weights: UInt8[np.ndarray, "vertices 4"]
    texture: Texture | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class LevelSet:
    """Where bricks are as dense as at the surface.

    Attributes:
        codes: Colors and density codes of all bricks.
        heights: Positive inside of the surface.
        low: Position of the first node, metres.
    """

    codes: UInt8[np.ndarray, "x y z 4"]
    heights: Float32[np.ndarray, "x y z"]
    low: Float32[np.ndarray, "3"]

    @classmethod
    def of(cls, bricks: BrickTable, density: float = SURFACE_DENSITY) -> "LevelSet":
        """The level set of baked bricks at a density (1/m)."""
        codes, low = _dense_grid(bricks)
        return cls(codes=codes, heights=_level_function(codes[..., 3], density), low=low)


def extract_mesh(
    tables: PlayerTables,
    level: LevelSet | None = None,
    *,
    spacing_m: float = 0.005,
    triangles: int | None = None,
    picture_by: PictureBy | None = None,
) -> SkinnedMesh:
    """Extract the surface of baked bricks, a vertex about every `spacing_m`.

    It is simplified to `triangles` (quadric error metrics, Garland and Heckbert 1997; needs
    fast-simplification) unless that is None. Give `level` if it is known. With `picture_by`, the
    mesh has a texture, which shows what these pictures show.
    """
    level = level or LevelSet.of(tables.bricks)
    codes, low, voxel_m = level.codes, level.low, tables.bricks.voxel_m
    step = spacing_m / voxel_m
    nodes, faces = extract_isosurface(resample_grid(level.heights, step))
    nodes *= np.float32(step)
    positions = (low + nodes * np.float32(voxel_m)).astype(np.float32)
    normals = _smooth_normals(positions, faces)
    if triangles is not None and triangles < len(faces):
        positions, normals, faces = _simplify(positions, normals, faces, triangles)

    def color_at(
        points: Float32[np.ndarray, "points 3"], directions: Float32[np.ndarray, "points 3"]
    ) -> UInt8[np.ndarray, "points 3"]:
        return _vertex_colors(codes, (points - low) / np.float32(voxel_m), directions, voxel_m)

    joints, weights = _strongest_joints(skinning_weights(tables, positions))
    mesh = SkinnedMesh(
        positions=positions,
        normals=normals,
        colors=color_at(positions, normals),
        faces=faces,
        joints=joints,
        weights=weights,
    )
    if picture_by is None:
        return mesh
    unwrapped = unwrap(positions, faces)
    copied = {
        name: getattr(mesh, name)[unwrapped.sources]
        for name in ("positions", "normals", "colors", "joints", "weights")
    }
    texture = draw_texture(unwrapped, copied["positions"], copied["normals"], color_at, picture_by)
    return replace(mesh, **copied, faces=unwrapped.faces, texture=texture)


def _simplify(
    positions: Float32[np.ndarray, "vertices 3"],
    normals: Float32[np.ndarray, "vertices 3"],
    faces: Int32[np.ndarray, "faces 3"],
    triangles: int,
) -> tuple[
    Float32[np.ndarray, "fewer 3"], Float32[np.ndarray, "fewer 3"], Int32[np.ndarray, "some 3"]
]:
    """Return a surface of fewer triangles, with the normals of the nearest vertices."""
    import fast_simplification  # not needed by the player

    found = positions, faces
    # the permitted error grows slowly, where edges go that cost least, then faster
    for growth in (2, 3, 7):
        if len(found[1]) > triangles:
            found = fast_simplification.simplify(*found, target_count=triangles, agg=growth)
    nearest = KDTree(positions).query(found[0])[1]
    return found[0].astype(np.float32), normals[nearest], found[1].astype(np.int32)


def _level_function(
    codes: UInt8[np.ndarray, "x y z"], density: float
) -> Float32[np.ndarray, "x y z"]:
    """Return a function that is positive inside: log-density over the level, without floaters."""
    # 1/m, of the faint cover that closes regions which no camera saw
    level, haze = density_code(np.array([density, 15.0])).astype(np.float32)
    solid = remove_floaters_and_cavities((codes > level) | _solid_interior(codes > haze))
    height = codes.astype(np.float32) - level
    height = np.where(solid, np.maximum(height, 1.0), np.minimum(height, -1.0))
    return ndimage.gaussian_filter(
        np.clip(height, -CODE_CONTRAST, CODE_CONTRAST), 0.75, truncate=3.0
    )


def _solid_interior(cover: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """Mark what lies well below a cover with holes."""
    closed = ndimage.binary_closing(cover, iterations=2)
    return np.asarray(ndimage.binary_erosion(fill_cavities(closed), iterations=3))


def skinning_weights(
    tables: PlayerTables, points: Float32[np.ndarray, "points 3"]
) -> Float32[np.ndarray, "points 24"]:
    """Return joints' weights at points near the surface; rows sum to 1.

    Trilinear between nodes of the skinning grid; the nearest node's where none about a point is
    stored.
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
    """Return all bricks in one grid with an empty border, and the position of its first node."""
    blocks = np.argwhere(bricks.index > 0)
    first, last = blocks.min(axis=0), blocks.max(axis=0)
    counts = (last - first + 1) * BRICK_SIZE
    codes = np.zeros((*(counts + 2 * BORDER_VOXELS), 4), dtype=np.uint8)
    cores = bricks.voxels[bricks.index[tuple(blocks.T)], :BRICK_SIZE, :BRICK_SIZE, :BRICK_SIZE]
    for corner, core in zip((blocks - first) * BRICK_SIZE + BORDER_VOXELS, cores, strict=True):
        codes[tuple(slice(c, c + BRICK_SIZE) for c in corner)] = core
    low = bricks.low + (first * BRICK_SIZE - BORDER_VOXELS) * bricks.voxel_m
    return codes, low.astype(np.float32)


def _smooth_normals(
    positions: Float32[np.ndarray, "vertices 3"], faces: Int32[np.ndarray, "faces 3"]
) -> Float32[np.ndarray, "vertices 3"]:
    """Average the faces' normals by area, then smooth them over adjacent vertices."""
    count = len(positions)
    a, b, c = (positions[corner] for corner in faces.T)
    areas = np.cross(b - a, c - a)
    touches = coo_array(
        (np.ones(faces.size), (faces.ravel(), np.repeat(np.arange(len(faces)), 3))),
        shape=(count, len(faces)),
    ).tocsr()
    adjacent = touches @ touches.T
    normals = _normalize(touches @ areas)
    for _ in range(6):  # as a trained field is not quite smooth
        normals = _normalize(adjacent @ normals)
    return normals.astype(np.float32)


def _normalize(vectors: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "vertices 3"]:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    upward = np.array([0.0, 1.0, 0.0])  # where a vertex's faces cancel out
    return np.where(length > 1e-12, vectors / np.maximum(length, 1e-12), upward)


def _vertex_colors(
    codes: UInt8[np.ndarray, "x y z 4"],
    nodes: Float32[np.ndarray, "vertices 3"],
    normals: Float32[np.ndarray, "vertices 3"],
    voxel_m: float,
) -> UInt8[np.ndarray, "vertices 3"]:
    """Composite the color of each vertex along its inward normal, from outside."""
    total = np.zeros((len(nodes), 3), dtype=np.float32)
    passed = np.ones(len(nodes), dtype=np.float32)
    for depth in np.arange(-0.004, 0.03, COLOR_STEP_M):
        place = (nodes - normals * np.float32(depth / voxel_m)).T
        sampled = [
            ndimage.map_coordinates(codes[..., channel], place, np.float32, order=1)
            for channel in range(4)
        ]
        left = passed * np.exp(-decode_density(sampled[3]) * COLOR_STEP_M).astype(np.float32)
        total += np.stack(sampled[:3], axis=1) * (passed - left)[:, None]
        passed = left
    opaque = 1.0 - passed
    colors = np.clip(np.round(total / np.maximum(opaque, 1e-3)[:, None]), 0, 255).astype(np.uint8)
    blank, known = opaque < 0.2, np.flatnonzero(opaque >= 0.2)
    if blank.any() and len(known):
        colors[blank] = colors[known[KDTree(nodes[known]).query(nodes[blank])[1]]]
    return colors


def _strongest_joints(
    weights: Float32[np.ndarray, "vertices 24"],
) -> tuple[UInt8[np.ndarray, "vertices 4"], UInt8[np.ndarray, "vertices 4"]]:
    """Return the strongest joints of each vertex and their weights as integers that sum to 255."""
    joints = np.argsort(-weights, axis=1, kind="stable")[:, :4]  # all importers read this many
    strongest = np.take_along_axis(weights, joints, axis=1).astype(np.float64)
    scaled = strongest / strongest.sum(axis=1, keepdims=True) * 255.0
    codes = np.floor(scaled).astype(np.int64)
    missing = 255 - codes.sum(axis=1, keepdims=True)
    rank = np.argsort(np.argsort(codes - scaled, axis=1, kind="stable"), axis=1)
    codes += rank < missing
    return np.where(codes > 0, joints, 0).astype(np.uint8), codes.astype(np.uint8)

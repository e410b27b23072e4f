"""Inputs of the player's graph: expanded tables, checked poses and cameras, limits of close-ups."""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, final

import numpy as np
from jaxtyping import Bool, Float32, Int, Int32, Shaped, UInt8

from capture.camera import Camera
from capture.input_error import InputError
from export.package.player_tables import (
    BRICK_NODES,
    PlayerTables,
    RenderSettings,
    SkinningGrid,
    SurfelTable,
)
from preprocess.body.body_pose import BodyPose
from preprocess.poses.plausibility import MAX_JOINT_ANGLE_RAD, exceeds_joint_limits

UNSTORED_M = 1e6
"""Canonical coordinates of nodes that are not stored, metres. They make the Jacobian so large that
it is never inverted: outside the stored cells a ray keeps its direction."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinningNodes:
    """Nodes of the skinning grid at its own step, or at half of it.

    Linear blend skinning, Σ w_j(x) B_j x, poses each node; positions in between are interpolated.
    At half the grid's step that is within some tenths of a millimetre of skinning itself.

    Attributes:
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
    """Return the nodes of a skinning grid."""
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
    return columns | _surfel_cells(nodes, surfels)


def _surfel_cells(nodes: SkinningNodes, surfels: SurfelTable) -> dict[str, np.ndarray]:
    """Return where surfels lie between skinning nodes, as columns.

    `cell_0` to `cell_3`: rows of the four lower nodes along z of the cell about each surfel, in C
    order; `fraction_x`, …: its position in the cell, from 0 to 1. A cell is cut into six tetrahedra
    along its diagonal; the one that holds the surfel is walked from the cell's lower to its upper
    corner along the axes in the order of their fractions: `tetrahedron_1` to `tetrahedron_3`, rows
    of its corners after `cell_0`; `share_0` to `share_3`, all corners' weights; `edge_normal_0` to
    `edge_normal_2`, the surfel's normal along its edges, per step between nodes.
    """
    counts = np.array(nodes.index.shape)
    place = (surfels.positions.astype(np.float64) - nodes.low) / nodes.step_m
    place = np.clip(place, 0.0, counts - 1 - 1e-3)
    below = place.astype(np.int32)
    fraction = place - below
    walk = np.argsort(-fraction, axis=1, kind="stable")
    along = np.take_along_axis(fraction, walk, axis=1)
    strides = np.array([counts[1] * counts[2], counts[2], 1])
    number, index = below @ strides, nodes.index.ravel()
    cell = [index[number + step] for step in (0, strides[1], strides[0], strides[0] + strides[1])]
    # rows of lower nodes by C order of x and y; a step along z adds 1
    corner, tetrahedron = np.zeros(len(number), dtype=np.intp), []
    for axis in walk.T:
        corner += np.array([4, 2, 1])[axis]
        tetrahedron.append(np.choose(corner >> 1, cell) + (corner & 1).astype(np.int32))
    bounds = np.pad(along, [(0, 0), (1, 1)], constant_values=[(0, 0), (1.0, 0.0)])
    normals = np.take_along_axis(surfels.normals * nodes.step_m, walk, axis=1)
    return {
        **{f"cell_{i}": rows for i, rows in enumerate(cell)},
        **{f"tetrahedron_{i}": rows for i, rows in enumerate(tetrahedron, 1)},
        **_float_columns("fraction_", "xyz", fraction),
        **_float_columns("share_", "0123", bounds[:, :-1] - bounds[:, 1:]),
        **_float_columns("edge_normal_", "012", normals),
    }


def _float_columns(
    name: str, endings: str, table: Shaped[np.ndarray, "rows columns"]
) -> dict[str, np.ndarray]:
    columns = zip(endings, table.T.astype(np.float32), strict=True)
    return {name + ending: np.ascontiguousarray(column) for ending, column in columns}


MAX_SAMPLES = 256
"""Largest number of density samples along 5 cm of a ray."""
MAX_PICTURE_PX = 8192
"""Longest side of a picture, pixels."""
MAX_MAGNITUDE = 1e8
"""Largest magnitude of an input in pixels, metres or radians."""
NODE_RADIUS_M = 0.05
"""Largest distance of a surfel from the nearest skinning node, metres."""
BAND_ROWS = 64
"""Rows that are enlarged at a time."""


def graph_inputs(
    bones: Float32[np.ndarray, "24 3 4"], camera: Camera, samples: int
) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Return the inputs of a graph by name, for camera-from-canonical matrices."""
    width, height = camera.size_px
    sizes = {"height": height, "width": width, "samples": samples}
    return {
        "bones": bones.reshape(24, 12),
        "camera": np.array([*camera.focal_px, *camera.center_px], dtype=np.float32),
        **{name: np.array(size, dtype=np.int64) for name, size in sizes.items()},
    }


def resize_camera(camera: Camera, size: int | np.integer | tuple[int, int] | None) -> Camera:
    """Return the camera, its field of view kept, for a longer side or (width, height) in pixels."""
    if size is None:
        return camera
    sides: Any = np.asarray(size)
    if sides.shape not in ((), (2,)) or sides.dtype.kind not in "iu" or sides.min() < 1:
        raise InputError(
            f"The picture's size is {size}; expected the longer side, or width and height, in "
            "whole pixels from 1 on."
        )
    return (
        camera.resize_longer_side(int(sides))
        if sides.ndim == 0
        else camera.resize((*sides.tolist(),))
    )


def fit_camera(camera: Camera, longest_px: int, *, max_upscale: int = 1) -> Camera:
    """Return the camera for a longer side of `longest_px`, or `max_upscale` × its own if less."""
    return camera.resize_longer_side(min(longest_px, max_upscale * max(camera.size_px)))


def check_render_inputs(pose: BodyPose, camera: Camera, samples: int) -> None:
    """Check pose, camera and number of samples."""
    if not 1 <= samples <= MAX_SAMPLES:
        raise InputError(f"{samples} samples are not possible; expected 1 to {MAX_SAMPLES}.")
    _check_array("root_rotation", pose.root_rotation, (3,))
    _check_array("root_translation", pose.root_translation, (3,))
    _check_array("joint_rotations", pose.joint_rotations, (23, 3))
    if exceeds_joint_limits(pose.joint_rotations):
        raise InputError(
            f"joint_rotations turn a joint by more than {np.rad2deg(MAX_JOINT_ANGLE_RAD):.0f}°; "
            "expected axis-angles in radians. Convert degrees by numpy.deg2rad(degrees)."
        )
    _check_array("camera_from_world", camera.camera_from_world, (4, 4))
    if camera.distortion:
        raise InputError(
            "The camera has lens distortion, but the player draws pinhole pictures. "
            "Leave the distortion out of the camera."
        )
    width, height = camera.size_px
    if not (0 < width <= MAX_PICTURE_PX and 0 < height <= MAX_PICTURE_PX):
        raise InputError(
            f"A picture of {width}x{height} px is not possible; expected 1 to {MAX_PICTURE_PX} px "
            "a side."
        )
    lens = np.array([*camera.focal_px, *camera.center_px])
    if not (np.abs(lens) < MAX_MAGNITUDE).all() or min(camera.focal_px) <= 0.0:
        raise InputError(
            f"The camera's focal lengths are {camera.focal_px} and its center {camera.center_px}; "
            "expected finite numbers of pixels, focal lengths above 0."
        )


def _check_array(name: str, array: Any, shape: tuple[int, ...]) -> None:
    if np.shape(array) != shape:
        raise InputError(f"{name} has the shape {np.shape(array)}; expected {shape}.")
    if not (np.abs(array) < MAX_MAGNITUDE).all():
        raise InputError(f"{name} holds NaN, infinity or a number above {MAX_MAGNITUDE:g}.")


@final
class ResolutionLimit:
    """The picture resolution up to which an avatar's surfels leave no gaps.

    A surfel covers at most `RenderSettings.max_footprint_px`; closer up, gaps would open between
    them. A voxel is dozens of pixels wide there: a coarser picture, enlarged, shows as much.
    """

    def __init__(self, tables: PlayerTables, settings: RenderSettings) -> None:
        """Store sizes; posed nodes are computed when they are needed."""
        self._skin, self._pelvis, self._reach_m = tables.skinning, tables.pelvis, tables.reach_m
        self._nearest_m, self._largest_px = settings.near_plane_m, settings.max_footprint_px
        self._footprint_m = tables.surfels.spacing_m * settings.footprint_spacings

    def downscale_factor(self, bones: Float32[np.ndarray, "24 3 4"], camera: Camera) -> float:
        """Return the factor by which a picture has to be coarser; 1 if surfels leave no gaps."""
        most = max(self._largest_px - 1, 1)
        footprint = max(camera.focal_px) * self._footprint_m  # pixels at a depth of 1 m
        depth = float(bones[0, 2, :3] @ self._pelvis + bones[0, 2, 3])
        if footprint <= most * (depth - self._reach_m):
            return 1.0
        return max(1.0, footprint / most / self._nearest_depth_m(bones, camera))

    def _nearest_depth_m(self, bones: Float32[np.ndarray, "24 3 4"], camera: Camera) -> float:
        """Return the least depth of skinning nodes that may be in the picture, metres."""
        weights, positions = self._nodes.weights[:, 1:-1], self._nodes.positions[1:-1]
        matrices = (weights.T @ bones.reshape(24, 12)).reshape(-1, 3, 4)
        there = np.einsum("nij,nj->ni", matrices[:, :, :3], positions) + matrices[:, :, 3]
        there = there[there[:, 2] > self._nearest_m - NODE_RADIUS_M]
        depth = np.maximum(there[:, 2], np.float32(self._nearest_m))
        focal, size = np.array(camera.focal_px), np.array(camera.size_px)
        place = there[:, :2] / depth[:, None] * focal + camera.center_px
        beside = self._largest_px / 2.0 + focal * NODE_RADIUS_M / depth[:, None]
        seen = ((place > -beside) & (place < size + beside)).all(axis=1)
        return float(depth[seen].min()) if seen.any() else np.inf

    @cached_property
    def _nodes(self) -> SkinningNodes:
        return stored_skinning_nodes(self._skin)


def downscale_camera(camera: Camera, factor: float) -> Camera:
    """Return the camera of a picture with pixels wider by a factor, and the same corner."""
    (fx, fy), (x, y), (width, height) = camera.focal_px, camera.center_px, camera.size_px
    return replace(
        camera,
        focal_px=(fx / factor, fy / factor),
        center_px=(x / factor, y / factor),
        size_px=(int(np.ceil(width / factor)), int(np.ceil(height / factor))),
    )


def upscale_picture(
    picture: UInt8[np.ndarray, "rows columns 4"], size_px: tuple[int, int], factor: float
) -> UInt8[np.ndarray, "height width 4"]:
    """Enlarge a picture of `downscale_camera(camera, factor)` to `size_px`, bilinearly."""
    width, height = size_px
    source = picture.astype(np.float32)
    source[..., :3] *= source[..., 3:] / np.float32(255.0)
    left, right, across = _bilinear_taps(width, source.shape[1], factor)
    upper, lower, along = _bilinear_taps(height, source.shape[0], factor)
    wide = source[:, left] * (1.0 - across[:, None]) + source[:, right] * across[:, None]
    whole = np.empty((height, width, 4), dtype=np.uint8)
    for start in range(0, height, BAND_ROWS):
        rows = slice(start, start + BAND_ROWS)
        share = along[rows, None, None]
        band = wide[upper[rows]] * (1.0 - share) + wide[lower[rows]] * share
        band[..., :3] *= np.float32(255.0) / np.maximum(band[..., 3:], np.float32(1e-3))
        whole[rows] = np.clip(np.rint(band), 0.0, 255.0)
    whole[whole[..., 3] == 0] = 0
    return whole


def _bilinear_taps(
    length: int, coarse_length: int, factor: float
) -> tuple[np.ndarray, np.ndarray, Float32[np.ndarray, "length"]]:
    """Return for each pixel along a side the two coarse ones beside it, and its fraction."""
    place = np.clip((np.arange(length) + 0.5) / factor - 0.5, 0.0, coarse_length - 1.0)
    before = np.floor(place).astype(np.intp)
    after = np.minimum(before + 1, coarse_length - 1)
    return before, after, (place - before).astype(np.float32)

"""Linear blend skinning of points and its Newton inverse along rays, in plain numpy."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64

from export.package.graph_tables import SkinningNodes
from export.package.render_settings import RenderSettings


class PosedNodes(NamedTuple):
    """Nodes of the skinning grid and their posed positions in the camera's frame, metres."""

    nodes: SkinningNodes
    camera: Float32[np.ndarray, "rows 3"]


class CanonicalRays(NamedTuple):
    """Straight segments of camera rays, carried into canonical space.

    Attributes:
        direction_camera: Unit directions from the camera's center.
        begin, end: Distances from the camera's center, metres.
        start_canonical: Canonical positions at `begin`.
        direction_canonical: Canonical metres per metre along the ray.
    """

    direction_camera: Float32[np.ndarray, "rays 3"]
    begin: Float32[np.ndarray, "rays"]
    end: Float32[np.ndarray, "rays"]
    start_canonical: Float32[np.ndarray, "rays 3"]
    direction_canonical: Float32[np.ndarray, "rays 3"]


def skin_trilinear(
    posed: PosedNodes, points: Float32[np.ndarray, "points 3"]
) -> tuple[Float32[np.ndarray, "points 3"], Float32[np.ndarray, "points 3 3"]]:
    """Skin canonical points, trilinear between posed nodes.

    Returns:
        Positions in the camera's frame, and the Jacobian; it is 0, so that it is never inverted,
        where one of the eight nodes is not stored.
    """
    nodes = posed.nodes
    last = np.array(nodes.index.shape) - 1
    place = np.clip((points - nodes.low) / nodes.step_m, 0.0, last - 1e-3)
    base = np.floor(place).astype(np.int64)
    part = (place - base).astype(np.float32)
    moved = np.zeros((len(points), 3), dtype=np.float32)
    jacobian = np.zeros((len(points), 3, 3), dtype=np.float32)
    stored = np.ones(len(points), dtype=bool)
    for corner in np.ndindex(2, 2, 2):
        below = nodes.index[tuple((base + np.array([*corner[:2], 0])).T)]
        stored &= below > 0
        there = posed.camera[below + corner[2]]
        x, y, z = np.where(corner, part, 1 - part).T
        moved += there * (x * y * z)[:, None]
        for axis, others in enumerate((y * z, x * z, x * y)):
            sign = (2 * corner[axis] - 1) / nodes.step_m[axis]
            jacobian[:, :, axis] += there * (others * sign)[:, None]
    jacobian[~stored] = 0.0
    return moved, jacobian


def skin_tetrahedral(
    posed: PosedNodes, points: Float32[np.ndarray, "points 3"]
) -> tuple[Float32[np.ndarray, "points 3"], Float32[np.ndarray, "points 3 3"]]:
    """Skin canonical points, linear in the six tetrahedra of each cell; as `skin_trilinear`."""
    nodes = posed.nodes
    last = np.array(nodes.index.shape) - 1
    place = np.clip((points - nodes.low) / nodes.step_m, 0.0, last - 1e-3).astype(np.float32)
    base = np.floor(place).astype(np.int64)
    moved = np.zeros((len(points), 3), dtype=np.float32)
    jacobian = np.zeros((len(points), 3, 3), dtype=np.float32)
    before = None
    for corner, share in _tetrahedron_walk(place - base):
        above = corner[:, 2]
        row = nodes.index[tuple((base + corner * np.array([1, 1, 0])).T)] + above
        there = posed.camera[row]
        moved += there * share[:, None]
        if before is not None:
            axis = (corner - before[1]).argmax(axis=1)
            step = (there - before[0]) / nodes.step_m[axis, None]
            jacobian[np.arange(len(points)), :, axis] = step
        before = there, corner
    return moved, jacobian


def _tetrahedron_walk(
    part: Float[np.ndarray, "points 3"],
) -> Iterator[tuple[Int64[np.ndarray, "points 3"], Float[np.ndarray, "points"]]]:
    """Yield the corners of each point's tetrahedron, relative to its cell, and their weights.

    Six tetrahedra share a cell's diagonal. Walking from the lower to the upper corner along the
    axes in descending order of the point's fractions visits the four corners of its tetrahedron.
    """
    order = np.argsort(-part, axis=1, kind="stable")
    shares = np.take_along_axis(part, order, axis=1)
    bounds = np.concatenate([np.ones((len(part), 1)), shares, np.zeros((len(part), 1))], axis=1)
    corner = np.zeros((len(part), 3), dtype=np.int64)
    for turn in range(4):
        yield corner.copy(), bounds[:, turn] - bounds[:, turn + 1]
        if turn < 3:
            corner[np.arange(len(part)), order[:, turn]] += 1


def compression_factor(
    settings: RenderSettings, direction: Float32[np.ndarray, "rays 3"]
) -> Float32[np.ndarray, "rays"]:
    """Factor, at most 1, by which lengths along rays shrink where the pose compresses space."""
    canonical_per_m = np.linalg.norm(direction, axis=1)
    return np.minimum(np.float32(settings.max_compression) / canonical_per_m, np.float32(1.0))


def invert_jacobians(
    settings: RenderSettings,
    jacobian: Float32[np.ndarray, "rays 3 3"],
) -> tuple[Float32[np.ndarray, "rays 3 3"], Bool[np.ndarray, "rays"]]:
    """Return inverse Jacobians, and which of them are sound; the others are arbitrary."""
    volume = np.linalg.det(jacobian)
    sound = (volume > 1 / settings.max_volume_ratio) & (volume < settings.max_volume_ratio)
    inverse = np.linalg.inv(np.where(sound[:, None, None], jacobian, np.eye(3)))
    return inverse.astype(np.float32), sound


def newton_correction(
    settings: RenderSettings, posed: PosedNodes, rays: CanonicalRays
) -> CanonicalRays:
    """Move canonical starts one Newton step onto their camera rays; update the directions."""
    camera, jacobian = skin_trilinear(posed, rays.start_canonical)
    inverse, sound = invert_jacobians(settings, jacobian)
    turned = np.einsum("nij,nj->ni", inverse, rays.direction_camera)
    inverse = inverse[sound]
    off = rays.begin[sound, None] * rays.direction_camera[sound] - camera[sound]
    shift = np.einsum("nij,nj->ni", inverse, off)
    length = np.linalg.norm(shift, axis=1, keepdims=True)
    start, direction = rays.start_canonical.copy(), rays.direction_canonical.copy()
    start[sound] += shift * np.minimum(settings.max_correction_m / np.maximum(length, 1e-10), 1.0)
    direction[sound] = turned[sound]
    return rays._replace(start_canonical=start, direction_canonical=direction)

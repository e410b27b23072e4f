"""Rays through the skin and the bricks in plain numpy: the part of the twin that gathers colour."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int64

from export.package.graph_tables import SkinningNodes
from export.package.player_tables import BRICK_NODES, BRICK_SIZE, LOG_DENSITY_RANGE, BrickTable
from export.package.render_settings import RenderSettings


class PosedNodes(NamedTuple):
    """The skin's nodes, and where they are in the camera's frame."""

    nodes: SkinningNodes
    camera: Float32[np.ndarray, "rows 3"]


class CanonicalRays(NamedTuple):
    """Pieces of rays, with canonical starts and directions."""

    direction_camera: Float32[np.ndarray, "rays 3"]
    begin: Float32[np.ndarray, "rays"]
    end: Float32[np.ndarray, "rays"]
    start_canonical: Float32[np.ndarray, "rays 3"]
    direction_canonical: Float32[np.ndarray, "rays 3"]


def skin_trilinear(
    posed: PosedNodes, points: Float32[np.ndarray, "points 3"]
) -> tuple[Float32[np.ndarray, "points 3"], Float32[np.ndarray, "points 3 3"]]:
    """Where canonical points are in the camera's frame, and the derivative: trilinear.

    The derivative is 0, which no inverse is taken of, where one of the eight nodes is not stored.
    """
    nodes = posed.nodes
    last = np.array(nodes.index.shape) - 1
    place = np.clip((points - nodes.low) / nodes.step_m, 0.0, last - 1e-3)
    base = np.floor(place).astype(np.int64)
    part = (place - base).astype(np.float32)
    moved = np.zeros((len(points), 3), dtype=np.float32)
    derivative = np.zeros((len(points), 3, 3), dtype=np.float32)
    stored = np.ones(len(points), dtype=bool)
    for corner in np.ndindex(2, 2, 2):
        below = nodes.index[tuple((base + np.array([*corner[:2], 0])).T)]
        stored &= below > 0
        there = posed.camera[below + corner[2]]
        x, y, z = np.where(corner, part, 1 - part).T
        moved += there * (x * y * z)[:, None]
        for axis, others in enumerate((y * z, x * z, x * y)):
            sign = (2 * corner[axis] - 1) / nodes.step_m[axis]
            derivative[:, :, axis] += there * (others * sign)[:, None]
    derivative[~stored] = 0.0
    return moved, derivative


def skin_tetrahedral(
    posed: PosedNodes, points: Float32[np.ndarray, "points 3"]
) -> tuple[Float32[np.ndarray, "points 3"], Float32[np.ndarray, "points 3 3"]]:
    """The same, linear in the tetrahedra of `read` instead of trilinear."""
    nodes = posed.nodes
    last = np.array(nodes.index.shape) - 1
    place = np.clip((points - nodes.low) / nodes.step_m, 0.0, last - 1e-3).astype(np.float32)
    base = np.floor(place).astype(np.int64)
    moved = np.zeros((len(points), 3), dtype=np.float32)
    derivative = np.zeros((len(points), 3, 3), dtype=np.float32)
    before = None
    for corner, share in _tetrahedron_walk(place - base):
        above = corner[:, 2]
        row = nodes.index[tuple((base + corner * np.array([1, 1, 0])).T)] + above
        there = posed.camera[row]
        moved += there * share[:, None]
        if before is not None:
            axis = (corner - before[1]).argmax(axis=1)
            step = (there - before[0]) / nodes.step_m[axis, None]
            derivative[np.arange(len(points)), :, axis] = step
        before = there, corner
    return moved, derivative


def _tetrahedron_walk(
    part: Float[np.ndarray, "points 3"],
) -> Iterator[tuple[Int64[np.ndarray, "points 3"], Float[np.ndarray, "points"]]]:
    """The corners of each point's tetrahedron, as steps from its cell's lowest, and their shares.

    A cell is cut into six tetrahedra along its diagonal. Walking from the lower to the upper
    corner along the axes in the order of their fractions passes the four corners of the one that
    holds the point.
    """
    order = np.argsort(-part, axis=1, kind="stable")
    shares = np.take_along_axis(part, order, axis=1)
    bounds = np.concatenate([np.ones((len(part), 1)), shares, np.zeros((len(part), 1))], axis=1)
    corner = np.zeros((len(part), 3), dtype=np.int64)
    for turn in range(4):
        yield corner.copy(), bounds[:, turn] - bounds[:, turn + 1]
        if turn < 3:
            corner[np.arange(len(part)), order[:, turn]] += 1


class CompositedBlock(NamedTuple):
    """What a block of samples adds, premultiplied, and the light that is left."""

    colors: Float[np.ndarray, "rays 4"]
    transmittance: Float[np.ndarray, "rays"]
    length_m: Float[np.ndarray, "rays"]


def composite_block(
    bricks: BrickTable,
    rays: CanonicalRays,
    light: Float[np.ndarray, "rays"],
    count: int,
    max_spacing: Float32[np.ndarray, "rays"] | float,
) -> CompositedBlock:
    """So many samples of density, at most `longest` apart, and one of colour at their mean."""
    step = np.minimum((rays.end - rays.begin) / count, max_spacing).astype(np.float32)
    weights, mean = np.zeros(len(step)), np.zeros(len(step))
    for turn in range(count):
        way = step * (turn + 0.5)
        density = sample_bricks(
            bricks, rays.start_canonical + way[:, None] * rays.direction_canonical
        )[1]
        weight = light * -np.expm1(-density * step)
        weights, mean, light = weights + weight, mean + weight * way, light - weight
    middle = (mean / np.maximum(weights, 1e-9)).astype(np.float32)
    rgb = sample_bricks(bricks, rays.start_canonical + middle[:, None] * rays.direction_canonical)[
        0
    ]
    colors = np.concatenate([rgb, np.ones((len(rgb), 1))], axis=1) * weights[:, None]
    return CompositedBlock(
        colors=colors.astype(np.float32), transmittance=light, length_m=step * count
    )


def march_rays(
    bricks: BrickTable, rules: RenderSettings, posed: PosedNodes, rays: CanonicalRays, samples: int
) -> Float32[np.ndarray, "rays 4"]:
    """Premultiplied colour and alpha: blocks of samples, a Newton step between them."""
    colors, light = np.zeros((len(rays.begin), 4), dtype=np.float32), np.ones(len(rays.begin))
    alive, rest = np.arange(len(light)), rays
    scale = -(-samples // rules.samples)
    for turn in range(rules.max_blocks * scale):
        if turn > 0:
            rest = newton_correction(rules, posed, rest)
        most = max_sample_spacing(rules, samples, turn, rest)
        block = composite_block(bricks, rest, light[alive], rules.block_samples, most)
        colors[alive] += block.colors
        light[alive] = block.transmittance
        rest = rest._replace(
            begin=rest.begin + block.length_m,
            start_canonical=rest.start_canonical
            + rest.direction_canonical * block.length_m[:, None],
        )
        going = (block.transmittance > rules.min_transmittance) & (rest.begin < rest.end - 1e-5)
        alive, rest = alive[going], CanonicalRays(*(part[going] for part in rest))
    return colors


def max_sample_spacing(
    rules: RenderSettings, samples: int, turn: int, rays: CanonicalRays
) -> Float32[np.ndarray, "rays"]:
    """How far apart the samples of rays' `turn`-th block may be, metres."""
    scale = -(-samples // rules.samples)
    if turn > 0 and turn == rules.max_blocks * scale - 1:
        return np.full(len(rays.begin), rules.max_segment_m, dtype=np.float32)
    usual = rules.sample_span_m / samples * 2.0 ** max(0, turn + 1 - rules.uniform_blocks * scale)
    return np.float32(usual) * compression_factor(rules, rays.direction_canonical)


def compression_factor(
    rules: RenderSettings, direction: Float32[np.ndarray, "rays 3"]
) -> Float32[np.ndarray, "rays"]:
    """Factor by which lengths along rays shrink where the pose compresses canonical space."""
    canonical_per_m = np.linalg.norm(direction, axis=1)
    return np.minimum(np.float32(rules.max_compression) / canonical_per_m, np.float32(1.0))


def newton_correction(
    rules: RenderSettings, posed: PosedNodes, rays: CanonicalRays
) -> CanonicalRays:
    """Canonical starts and directions after a Newton step."""
    camera, derivative = skin_trilinear(posed, rays.start_canonical)
    volume = np.linalg.det(derivative)
    sound = (volume > 1 / rules.max_volume_ratio) & (volume < rules.max_volume_ratio)
    inverse = np.linalg.inv(derivative[sound])
    off = rays.begin[sound, None] * rays.direction_camera[sound] - camera[sound]
    shift = np.einsum("nij,nj->ni", inverse, off)
    length = np.linalg.norm(shift, axis=1, keepdims=True)
    start, direction = rays.start_canonical.copy(), rays.direction_canonical.copy()
    start[sound] += shift * np.minimum(rules.max_correction_m / np.maximum(length, 1e-10), 1.0)
    direction[sound] = np.einsum("nij,nj->ni", inverse, rays.direction_camera[sound])
    return rays._replace(start_canonical=start, direction_canonical=direction)


def sample_bricks(
    bricks: BrickTable, points: Float32[np.ndarray, "points 3"]
) -> tuple[Float32[np.ndarray, "points 3"], Float32[np.ndarray, "points"]]:
    """Color in [0, 1] and density (1/m) at canonical points, interpolated in tetrahedra.

    Log-density is interpolated, and below half a code there is nothing.
    """
    last = np.array(bricks.index.shape) * BRICK_SIZE - 1e-3
    place = np.clip((points - bricks.low) / bricks.voxel_m, 0.0, last).astype(np.float32)
    voxel = np.floor(place).astype(np.int64)
    brick = bricks.index[tuple((voxel // BRICK_SIZE).T)]
    corner = (voxel % BRICK_SIZE).astype(np.int32)
    assert corner.max(initial=0) < BRICK_NODES - 1
    codes = np.zeros((len(points), 4), dtype=np.float32)
    for step, share in _tetrahedron_walk(place - voxel):
        codes += bricks.voxels[(brick, *(corner + step).T)] * share[:, None]
    low, high = LOG_DENSITY_RANGE
    density = np.exp(codes[:, 3] / 255.0 * (high - low) + low)
    density = np.where(codes[:, 3] > 0.5, density, 0.0)
    return (codes[:, :3] / 255.0).astype(np.float32), density.astype(np.float32)

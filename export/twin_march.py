"""Rays through the skin and the bricks in plain numpy: the part of the twin that gathers colour."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int64

from export.rules import DrawingRules
from export.skin import SkinNodes
from export.tables import BRICK, LOG_DENSITY, NODES, Bricks


class PosedNodes(NamedTuple):
    """The skin's nodes, and where they are in the camera's frame."""

    nodes: SkinNodes
    camera: Float32[np.ndarray, "rows 3"]


class Rays(NamedTuple):
    """Pieces of rays, with canonical starts and directions."""

    ray: Float32[np.ndarray, "rays 3"]
    begin: Float32[np.ndarray, "rays"]
    end: Float32[np.ndarray, "rays"]
    start: Float32[np.ndarray, "rays 3"]
    direction: Float32[np.ndarray, "rays 3"]


def carried(
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


def carried_in_tetrahedra(
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
    for corner, share in _way(place - base):
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


def _way(
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


class Block(NamedTuple):
    """What a block of samples adds, premultiplied, and the light that is left."""

    colors: Float[np.ndarray, "rays 4"]
    light: Float[np.ndarray, "rays"]
    way: Float[np.ndarray, "rays"]


def sampled(
    bricks: Bricks,
    rays: Rays,
    light: Float[np.ndarray, "rays"],
    count: int,
    longest: Float32[np.ndarray, "rays"] | float,
) -> Block:
    """So many samples of density, at most `longest` apart, and one of colour at their mean."""
    step = np.minimum((rays.end - rays.begin) / count, longest).astype(np.float32)
    weights, mean = np.zeros(len(step)), np.zeros(len(step))
    for turn in range(count):
        way = step * (turn + 0.5)
        density = read(bricks, rays.start + way[:, None] * rays.direction)[1]
        weight = light * -np.expm1(-density * step)
        weights, mean, light = weights + weight, mean + weight * way, light - weight
    middle = (mean / np.maximum(weights, 1e-9)).astype(np.float32)
    rgb = read(bricks, rays.start + middle[:, None] * rays.direction)[0]
    colors = np.concatenate([rgb, np.ones((len(rgb), 1))], axis=1) * weights[:, None]
    return Block(colors=colors.astype(np.float32), light=light, way=step * count)


def march(
    bricks: Bricks, rules: DrawingRules, posed: PosedNodes, rays: Rays, samples: int
) -> Float32[np.ndarray, "rays 4"]:
    """Premultiplied colour and alpha: blocks of samples, a Newton step between them."""
    colors, light = np.zeros((len(rays.begin), 4), dtype=np.float32), np.ones(len(rays.begin))
    alive, rest = np.arange(len(light)), rays
    scale = -(-samples // rules.samples)
    for turn in range(rules.blocks * scale):
        if turn > 0:
            rest = led_back(rules, posed, rest)
        most = longest(rules, samples, turn, rest)
        block = sampled(bricks, rest, light[alive], rules.block, most)
        colors[alive] += block.colors
        light[alive] = block.light
        rest = rest._replace(
            begin=rest.begin + block.way, start=rest.start + rest.direction * block.way[:, None]
        )
        going = (block.light > rules.ended) & (rest.begin < rest.end - 1e-5)
        alive, rest = alive[going], Rays(*(part[going] for part in rest))
    return colors


def longest(
    rules: DrawingRules, samples: int, turn: int, rays: Rays
) -> Float32[np.ndarray, "rays"]:
    """How far apart the samples of rays' `turn`-th block may be, metres."""
    scale = -(-samples // rules.samples)
    if turn > 0 and turn == rules.blocks * scale - 1:
        return np.full(len(rays.begin), rules.longest_m, dtype=np.float32)
    usual = rules.span_m / samples * 2.0 ** max(0, turn + 1 - rules.steady * scale)
    return np.float32(usual) * unsquashed(rules, rays.direction)


def unsquashed(
    rules: DrawingRules, direction: Float32[np.ndarray, "rays 3"]
) -> Float32[np.ndarray, "rays"]:
    """Factor by which lengths along rays shrink where the pose compresses canonical space."""
    canonical_per_m = np.linalg.norm(direction, axis=1)
    return np.minimum(np.float32(rules.squash_limit) / canonical_per_m, np.float32(1.0))


def led_back(rules: DrawingRules, posed: PosedNodes, rays: Rays) -> Rays:
    """Canonical starts and directions after a Newton step."""
    camera, derivative = carried(posed, rays.start)
    volume = np.linalg.det(derivative)
    sound = (volume > 1 / rules.stretch) & (volume < rules.stretch)
    inverse = np.linalg.inv(derivative[sound])
    off = rays.begin[sound, None] * rays.ray[sound] - camera[sound]
    shift = np.einsum("nij,nj->ni", inverse, off)
    length = np.linalg.norm(shift, axis=1, keepdims=True)
    start, direction = rays.start.copy(), rays.direction.copy()
    start[sound] += shift * np.minimum(rules.longest_correction_m / np.maximum(length, 1e-10), 1.0)
    direction[sound] = np.einsum("nij,nj->ni", inverse, rays.ray[sound])
    return rays._replace(start=start, direction=direction)


def read(
    bricks: Bricks, points: Float32[np.ndarray, "points 3"]
) -> tuple[Float32[np.ndarray, "points 3"], Float32[np.ndarray, "points"]]:
    """Colour in [0, 1] and density (1/m) at canonical points, interpolated in tetrahedra.

    Log-density is interpolated, and below half a code there is nothing.
    """
    last = np.array(bricks.index.shape) * BRICK - 1e-3
    place = np.clip((points - bricks.low) / bricks.voxel_m, 0.0, last).astype(np.float32)
    voxel = np.floor(place).astype(np.int64)
    brick = bricks.index[tuple((voxel // BRICK).T)]
    corner = (voxel % BRICK).astype(np.int32)
    assert corner.max(initial=0) < NODES - 1
    codes = np.zeros((len(points), 4), dtype=np.float32)
    for step, share in _way(place - voxel):
        codes += bricks.voxels[(brick, *(corner + step).T)] * share[:, None]
    low, high = LOG_DENSITY
    density = np.exp(codes[:, 3] / 255.0 * (high - low) + low)
    density = np.where(codes[:, 3] > 0.5, density, 0.0)
    return (codes[:, :3] / 255.0).astype(np.float32), density.astype(np.float32)

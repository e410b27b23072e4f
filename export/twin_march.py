"""Rays through the skin and the bricks in plain numpy: the part of the twin that gathers colour."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

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
    """Where canonical points are in the camera's frame, and the derivative: trilinear."""
    nodes = posed.nodes
    last = np.array(nodes.index.shape) - 1
    place = np.clip((points - nodes.low) / nodes.step_m, 0.0, last - 1e-3)
    base = np.floor(place).astype(np.int64)
    part = (place - base).astype(np.float32)
    moved = np.zeros((len(points), 3), dtype=np.float32)
    derivative = np.zeros((len(points), 3, 3), dtype=np.float32)
    for corner in np.ndindex(2, 2, 2):
        below = nodes.index[tuple((base + np.array([*corner[:2], 0])).T)]
        there = posed.camera[below + corner[2]]
        shares = np.where(corner, part, 1 - part)
        moved += there * shares.prod(axis=1, keepdims=True)
        for axis in range(3):
            others = np.delete(shares, axis, axis=1).prod(axis=1)
            sign = (2 * corner[axis] - 1) / nodes.step_m[axis]
            derivative[:, :, axis] += there * (others * sign)[:, None]
    return moved, derivative


def march(
    bricks: Bricks, rules: DrawingRules, posed: PosedNodes, rays: Rays, samples: int, steady: int
) -> Float32[np.ndarray, "rays 4"]:
    """Premultiplied colour and alpha: blocks of samples, a Newton step after each."""
    colors = np.zeros((len(rays.begin), 4), dtype=np.float32)
    place, point, direction = (np.array(a) for a in (rays.begin, rays.start, rays.direction))
    alive, blocks = np.arange(len(place)), 0
    while len(alive):
        longest = rules.span_m / samples * 2.0 ** max(0, blocks + 1 - steady)
        blocks += 1
        step = (rays.end[alive] - place[alive]) / rules.block
        step = np.minimum(step, longest).astype(np.float32)
        for turn in range(rules.block):
            way = (step * (turn + 0.5))[:, None]
            rgb, density = read(bricks, point[alive] + way * direction[alive])
            weight = (1.0 - colors[alive, 3]) * -np.expm1(-density * step)
            colors[alive] += np.concatenate([rgb, np.ones((len(rgb), 1))], 1) * weight[:, None]
        place[alive] += step * rules.block
        point[alive] += direction[alive] * (step * rules.block)[:, None]
        going = (1.0 - colors[alive, 3] > rules.ended) & (place[alive] < rays.end[alive] - 1e-5)
        alive = alive[going]
        camera, derivative = carried(posed, point[alive])
        volume = np.linalg.det(derivative)
        sound = (volume > 1 / rules.stretch) & (volume < rules.stretch)
        led, inverse = alive[sound], np.linalg.inv(derivative[sound])
        off = place[led, None] * rays.ray[led] - camera[sound]
        shift = np.einsum("nij,nj->ni", inverse, off)
        length = np.linalg.norm(shift, axis=1, keepdims=True)
        share = np.minimum(rules.longest_correction_m / np.maximum(length, 1e-10), 1.0)
        point[led] += shift * share
        direction[led] = np.einsum("nij,nj->ni", inverse, rays.ray[led])
    return colors


def read(
    bricks: Bricks, points: Float32[np.ndarray, "points 3"]
) -> tuple[Float32[np.ndarray, "points 3"], Float32[np.ndarray, "points"]]:
    """Colour in [0, 1] and density (1/m) at canonical points, interpolated in tetrahedra.

    A cell is cut into six tetrahedra along its diagonal. Walking from the lower to the upper
    corner along the axes in the order of their fractions passes the four corners of the one that
    holds the point; log-density is interpolated, and below half a code there is nothing.
    """
    last = np.array(bricks.index.shape) * BRICK - 1e-3
    place = np.clip((points - bricks.low) / bricks.voxel_m, 0.0, last).astype(np.float32)
    voxel = np.floor(place).astype(np.int64)
    part = place - voxel
    order = np.argsort(-part, axis=1, kind="stable")
    sorted_part = np.take_along_axis(part, order, axis=1)
    bounds = np.concatenate(
        [np.ones((len(part), 1)), sorted_part, np.zeros((len(part), 1))], axis=1
    )
    brick = bricks.index[tuple((voxel // BRICK).T)]
    corner = (voxel % BRICK).astype(np.int32)
    assert corner.max(initial=0) < NODES - 1
    codes = np.zeros((len(points), 4), dtype=np.float32)
    for turn in range(4):
        share = (bounds[:, turn] - bounds[:, turn + 1])[:, None]
        codes += bricks.voxels[(brick, *corner.T)] * share
        if turn < 3:
            corner[np.arange(len(points)), order[:, turn]] += 1
    low, high = LOG_DENSITY
    density = np.exp(codes[:, 3] / 255.0 * (high - low) + low)
    density = np.where(codes[:, 3] > 0.5, density, 0.0)
    return (codes[:, :3] / 255.0).astype(np.float32), density.astype(np.float32)

"""The player's picture computed in plain numpy: what the graph means, and its test.

Written after the tables and the rules alone, with arrays of vectors and numpy's own inverse; it
shares no code with the graph.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from export.rules import DrawingRules
from export.tables import BRICK, DEPTH_STEPS, LOG_DENSITY, NODES, SURFEL_BITS, Bricks, Tables

FAR = 2**31 - 1


@dataclass(frozen=True, eq=False, kw_only=True)
class Shot:
    """What the graph is given besides the tables.

    Attributes:
        bones: Camera-from-canonical matrices.
        focal, center: Pixels.
        size_px: Width and height.
        samples: Along each ray and layer.
    """

    bones: Float32[np.ndarray, "24 3 4"]
    focal: Float32[np.ndarray, "2"]
    center: Float32[np.ndarray, "2"]
    size_px: tuple[int, int]
    samples: int


@dataclass(frozen=True, eq=False, kw_only=True)
class _Posed:
    """The hull in the camera's frame."""

    matrices: Float32[np.ndarray, "surfels 3 4"]
    camera: Float32[np.ndarray, "surfels 3"]


def draw(tables: Tables, rules: DrawingRules, shot: Shot) -> Float32[np.ndarray, "height width 4"]:
    """Premultiplied colour and alpha in [0, 1]."""
    surfels, (width, height) = tables.surfels, shot.size_px
    flat = surfels.weights @ shot.bones.reshape(24, 12)
    matrices = flat.reshape(-1, 3, 4)
    moved = np.einsum("nij,nj->ni", matrices[:, :, :3], surfels.positions) + matrices[:, :, 3]
    posed = _Posed(matrices=matrices, camera=moved)

    pixel, key, deep_enough = _footprints(tables, rules, shot, posed)
    buffer = np.full(width * height, FAR, dtype=np.int64)
    np.minimum.at(buffer, pixel, key)
    filled = _without_holes(buffer.reshape(height, width), tables, rules).ravel()
    picture = np.zeros((width * height, 4), dtype=np.float32)
    covered = np.flatnonzero(filled < FAR)
    picture[covered], begin = _shade(tables, rules, shot, posed, covered, filled[covered])
    if rules.layers == 2:
        passed = 1.0 - picture[:, 3]
        limit = np.full(width * height, 1e6, dtype=np.float32)
        limit[covered] = begin + np.float32(rules.gap_m)
        limit[passed <= rules.transmitted] = 1e6
        behind = deep_enough > limit[pixel]
        buffer = np.full(width * height, FAR, dtype=np.int64)
        np.minimum.at(buffer, pixel[behind], key[behind])
        again = np.flatnonzero(buffer < FAR)
        second, _ = _shade(tables, rules, shot, posed, again, buffer[again])
        picture[again] += second * passed[again, None]
    return picture.reshape(height, width, 4)


def _footprints(
    tables: Tables, rules: DrawingRules, shot: Shot, posed: _Posed
) -> tuple[Int64[np.ndarray, "splats"], Int64[np.ndarray, "splats"], Float32[np.ndarray, "splats"]]:
    """Each visible surfel's pixels with its key, and its depth if it may form the second layer."""
    (width, height), depth = shot.size_px, posed.camera[:, 2]
    safe = np.maximum(depth, np.float32(rules.nearest_m))[:, None]
    place = posed.camera[:, :2] / safe * shot.focal + shot.center
    normals = np.einsum("nij,nj->ni", posed.matrices[:, :, :3], tables.surfels.normals)
    facing = np.einsum("ni,ni->n", normals, posed.camera)
    margin = rules.largest_footprint_px
    seen = (depth > rules.nearest_m) & (facing < depth * rules.behind)
    seen &= (place > -margin).all(axis=1) & (place < np.array(shot.size_px) + margin).all(axis=1)
    surfel = np.flatnonzero(seen)
    if len(surfel) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.float32)
    depth, place, facing = depth[surfel], place[surfel], facing[surfel]

    spacing_px = shot.focal.max() * tables.surfels.spacing_m / depth.min()
    side = int(np.floor(spacing_px * rules.footprint_spacings + 0.999))
    side = int(np.clip(side, 2, rules.largest_footprint_px))
    near = shot.bones[0, 2, :3] @ tables.pelvis + shot.bones[0, 2, 3] - tables.reach_m
    code = (depth - near) / (2.0 * tables.reach_m) * (DEPTH_STEPS - 1)
    key = (np.clip(code, 0, DEPTH_STEPS - 1).astype(np.int64) << SURFEL_BITS) | surfel
    deep_enough = np.where(facing < -depth * rules.facing, depth, np.float32(0.0))

    first = np.floor(place - np.float32((side - 1) / 2)).astype(np.int64)
    steps = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 1, 2)
    column, row = np.moveaxis(first + steps, -1, 0)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    shape = inside.shape
    pixel = (row * width + column)[inside]
    return pixel, np.broadcast_to(key, shape)[inside], np.broadcast_to(deep_enough, shape)[inside]


def _without_holes(
    keys: Int64[np.ndarray, "height width"], tables: Tables, rules: DrawingRules
) -> Int64[np.ndarray, "height width"]:
    padded = np.pad(keys, 1, constant_values=0)
    across = np.maximum(padded[1:-1, :-2], padded[1:-1, 2:])
    along = np.maximum(padded[:-2, 1:-1], padded[2:, 1:-1])
    # a border of zeros would fill; outside of the picture nothing overtops
    across[:, [0, -1]] = FAR
    along[[0, -1]] = FAR
    neighbours = np.minimum(across, along)
    steps = int(rules.hole_m / (2.0 * tables.reach_m) * DEPTH_STEPS)
    return np.where(keys - (steps << SURFEL_BITS) > neighbours, neighbours, keys)


def _shade(
    tables: Tables,
    rules: DrawingRules,
    shot: Shot,
    posed: _Posed,
    pixel: Int64[np.ndarray, "pixels"],
    key: Int64[np.ndarray, "pixels"],
) -> tuple[Float32[np.ndarray, "pixels 4"], Float32[np.ndarray, "pixels"]]:
    """Premultiplied colour and alpha of covered pixels, and the depth where their rays begin."""
    surfels, surfel = tables.surfels, key & ((1 << SURFEL_BITS) - 1)
    row, column = np.divmod(pixel, shot.size_px[0])
    plane = (np.stack([column, row], axis=1) + 0.5 - shot.center) / shot.focal
    ray = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    ray = (ray / np.linalg.norm(ray, axis=1, keepdims=True)).astype(np.float32)

    inverse = np.linalg.inv(_derivative(tables, rules, shot, posed, surfel))
    direction = np.einsum("nij,nj->ni", inverse, ray)
    to_surfel = np.einsum("nij,nj->ni", inverse, posed.camera[surfel])
    normal, thickness = surfels.normals[surfel], surfels.thickness[surfel]

    falling = (normal * direction).sum(axis=1)
    along = (posed.camera[surfel] * ray).sum(axis=1)
    shallow = np.float32(-0.5 * rules.steepest)
    hit = (normal * to_surfel).sum(axis=1) / np.minimum(falling, shallow)
    begin = np.where(falling < shallow, hit, along)
    begin = np.clip(begin, along - rules.slack_m, along + rules.slack_m)
    cosine = np.maximum(-falling, rules.steepest)
    lead = np.minimum(rules.lead_m / cosine, rules.most_lead_m)
    begin = begin - lead
    sine = 1.0 - falling**2 / (direction**2).sum(axis=1)
    length = thickness * (1.0 + rules.grazing * sine) / cosine
    length = np.minimum(length + lead, rules.longest_m)

    picture = np.zeros((len(pixel), 4), dtype=np.float32)
    step = length / shot.samples
    for turn in range(shot.samples):
        distance = (begin + step * (turn + 0.5))[:, None]
        points = surfels.positions[surfel] - to_surfel + distance * direction
        rgb, density = read(tables.bricks, points)
        weight = (1.0 - picture[:, 3]) * -np.expm1(-density * step)
        picture[:, :3] += rgb * weight[:, None]
        picture[:, 3] += weight
    return picture, begin * ray[:, 2]


def _derivative(
    tables: Tables,
    rules: DrawingRules,
    shot: Shot,
    posed: _Posed,
    surfel: Int64[np.ndarray, "pixels"],
) -> Float32[np.ndarray, "pixels 3 3"]:
    """Derivative of linear blend skinning at surfels; of the blended matrix alone at bad folds."""
    blended = posed.matrices[surfel][:, :, :3]
    canonical = tables.surfels.positions[surfel]
    by_bone = np.einsum("kij,nj->nki", shot.bones[:, :, :3], canonical) + shot.bones[:, :, 3]
    offset = by_bone - posed.camera[surfel][:, None]
    gradient = tables.surfels.weight_gradients[surfel]
    full = blended + np.einsum("nki,nak->nia", offset, gradient)
    volume = np.linalg.det(full)
    sound = (volume > 1 / rules.stretch) & (volume < rules.stretch)
    return np.where(sound[:, None, None], full, blended)


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

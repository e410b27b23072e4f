"""The player's picture computed in plain numpy: what the graph means, and its test.

Written after the tables and the rules alone, with arrays of vectors and numpy's own inverse; it
shares no code with the graph.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int64

from export.package.graph_tables import skinning_nodes
from export.package.player_tables import DEPTH_CODES, SURFEL_BITS, PlayerTables
from export.package.render_settings import RenderSettings
from export.reference.reference_march import (
    CanonicalRays,
    PosedNodes,
    composite_block,
    compression_factor,
    march_rays,
    skin_tetrahedral,
    skin_trilinear,
)

EMPTY_PIXEL_KEY = 2**31 - 1

FirstLayerCompositor = Callable[[PosedNodes, CanonicalRays], Float32[np.ndarray, "rays 4"]]
"""Premultiplied colour and alpha of the first layer's rays."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PlayerInputs:
    """What the graph is given besides the tables.

    Attributes:
        bones: Camera-from-canonical matrices.
        focal, center: Pixels.
        size_px: Width and height.
        samples: Along the rules' `sample_span_m` of each ray.
    """

    bones: Float32[np.ndarray, "24 3 4"]
    focal: Float32[np.ndarray, "2"]
    center: Float32[np.ndarray, "2"]
    size_px: tuple[int, int]
    samples: int


@dataclass(frozen=True, eq=False, kw_only=True)
class _PosedSurface:
    """The skin and, linear in tetrahedra, the hull in the camera's frame.

    `facing` is the ray to each surfel along its normal in canonical space, negative where it faces
    the camera; `volume` the ratio of posed to canonical volume, negative where it is inside out.
    """

    nodes: PosedNodes
    positions: Float32[np.ndarray, "surfels 3"]
    facing: Float32[np.ndarray, "surfels"]
    volume: Float32[np.ndarray, "surfels"]


@dataclass(frozen=True, eq=False, kw_only=True)
class _PreviousLayer:
    """What a layer saw at the next one's pixels: its surfels, and where its rays ended."""

    surfel: Int64[np.ndarray, "pixels"]
    end: Float32[np.ndarray, "pixels"]


class FurtherLayer(NamedTuple):
    """A further layer.

    Attributes:
        again: Which of the first layer's rays have it, ascending.
        rays: Theirs.
    """

    ray_index: Int64[np.ndarray, "rays"]
    rays: CanonicalRays


@dataclass(frozen=True, eq=False, kw_only=True)
class TracedPicture:
    """Where a picture's rays go through canonical space, and what the first layer shows.

    Attributes:
        pixel: Numbers of the covered pixels, ascending.
        nodes: The skin in this pose.
        first: Their rays.
        seen: What these show: premultiplied colour and alpha.
        behind: The further layers.
    """

    pixel: Int64[np.ndarray, "pixels"]
    nodes: PosedNodes
    first_rays: CanonicalRays
    first_colors: Float32[np.ndarray, "pixels 4"]
    further_layers: tuple[FurtherLayer, ...]


def draw_reference(
    tables: PlayerTables, settings: RenderSettings, inputs: PlayerInputs
) -> Float32[np.ndarray, "height width 4"]:
    """Premultiplied colour and alpha in [0, 1]."""
    width, height = inputs.size_px
    look = trace_picture(tables, settings, inputs)
    seen = look.first_colors.copy()
    for again, rays in look.further_layers:
        seen[again] += _composite_further_layer(tables, settings, rays) * (1.0 - seen[again, 3:])
    picture = np.zeros((width * height, 4), dtype=np.float32)
    picture[look.pixel] = seen
    return picture.reshape(height, width, 4)


def _composite_further_layer(
    tables: PlayerTables, rules: RenderSettings, rays: CanonicalRays
) -> Float32[np.ndarray, "rays 4"]:
    """What rays of a further layer show."""
    ones = np.ones(len(rays.begin))
    return composite_block(tables.bricks, rays, ones, rules.further_layer_samples, np.inf).colors


def trace_picture(
    tables: PlayerTables,
    settings: RenderSettings,
    inputs: PlayerInputs,
    composite_first: FirstLayerCompositor | None = None,
) -> TracedPicture:
    """Finds the rays of all layers.

    Args:
        tables: What is drawn.
        rules: How.
        shot: From where, in which pose.
        marched: What the first layer's rays show, if not by `twin_march.march`.
    """
    width, height = inputs.size_px
    posed = _pose_surface(tables, settings, inputs)
    side = _footprint_px(tables, settings, inputs, posed)
    cell, key, deep_enough = _splat_surfels(tables, settings, inputs, posed, side)
    cells = (height + 2 * side, width + 2 * side)  # the picture and its surroundings
    buffer = np.full(cells, EMPTY_PIXEL_KEY, dtype=np.int64)
    np.minimum.at(buffer.reshape(-1), cell, key)
    filled = _fill_holes(buffer, tables, settings, side).ravel()
    covered = np.flatnonzero(filled < EMPTY_PIXEL_KEY)
    first, depth = _ray_entries(tables, settings, inputs, posed, covered, filled[covered], None)
    if composite_first is None:
        seen = march_rays(tables.bricks, settings, posed.nodes, first, inputs.samples)
    else:
        seen = composite_first(posed.nodes, first)
    behind = list[FurtherLayer]()
    light, end, keys = 1.0 - seen[:, 3], first.end.copy(), filled[covered]
    again = np.arange(len(covered))
    while len(behind) < settings.layers - 1:
        again = again[light[again] > settings.layer_min_transmittance]
        limit = np.full((height, width), 1e6, dtype=np.float32)
        limit.reshape(-1)[covered[again]] = depth[again] + np.float32(settings.layer_gap_m)
        limits = np.pad(limit, side, constant_values=1e6).reshape(-1)[cell]
        there = deep_enough > limits
        if settings.other_sheet_gap_m < settings.layer_gap_m:
            passed = np.zeros((height, width), dtype=np.int64)
            passed.reshape(-1)[covered[again]] = _surfel_of_key(keys[again])
            limits -= np.float32(settings.layer_gap_m - settings.other_sheet_gap_m)
            near = np.flatnonzero(~there & (deep_enough > limits))
            before = np.pad(passed, side).reshape(-1)[cell[near]]
            there[near] = ~_one_sheet(
                settings, tables, posed.positions, _surfel_of_key(key[near]), before
            )
        buffer = np.full(cells, EMPTY_PIXEL_KEY, dtype=np.int64)
        np.minimum.at(buffer.reshape(-1), cell[there], key[there])
        found = buffer[side:-side, side:-side].ravel()[covered]
        again = np.flatnonzero(found < EMPTY_PIXEL_KEY)
        before = _PreviousLayer(surfel=_surfel_of_key(keys[again]), end=end[again])
        rays, entered = _ray_entries(
            tables, settings, inputs, posed, covered[again], found[again], before
        )
        behind.append(FurtherLayer(again, rays))
        light[again] *= 1.0 - _composite_further_layer(tables, settings, rays)[:, 3]
        depth[again], end[again], keys[again] = entered, rays.end, found[again]
    return TracedPicture(
        pixel=covered,
        nodes=posed.nodes,
        first_rays=first,
        first_colors=seen,
        further_layers=tuple(behind),
    )


def _one_sheet(
    rules: RenderSettings,
    tables: PlayerTables,
    camera: Float32[np.ndarray, "surfels 3"],
    one: Int64[np.ndarray, "pairs"],
    other: Int64[np.ndarray, "pairs"],
) -> Bool[np.ndarray, "pairs"]:
    """Whether pairs of surfels are no farther apart in canonical space than as they are posed."""
    places = tables.surfels.positions
    apart = np.linalg.norm(places[one] - places[other], axis=1)
    posed = np.linalg.norm(camera[one] - camera[other], axis=1)
    return apart < posed * rules.same_sheet_ratio + rules.same_sheet_m


def _pose_surface(tables: PlayerTables, rules: RenderSettings, shot: PlayerInputs) -> _PosedSurface:
    nodes = skinning_nodes(tables.skinning, rules.skinning_subdivision)
    blended = (nodes.weights.T @ shot.bones.reshape(24, 12)).reshape(-1, 3, 4)
    node_camera = np.einsum("nij,nj->ni", blended[:, :, :3], nodes.positions) + blended[:, :, 3]
    there = PosedNodes(nodes, node_camera)
    splatted, edges = skin_tetrahedral(there, tables.surfels.positions)
    volume = np.linalg.det(edges)
    flat = np.abs(volume) < 1e-12
    from_eye = np.linalg.solve(np.where(flat[:, None, None], np.eye(3), edges), splatted[..., None])
    facing = np.einsum("ni,ni->n", tables.surfels.normals, from_eye[..., 0])
    return _PosedSurface(
        nodes=there,
        positions=splatted,
        facing=np.where(flat, 0.0, facing).astype(np.float32),
        volume=volume,
    )


def _inverse_skinning(
    rules: RenderSettings, posed: _PosedSurface, points: Float32[np.ndarray, "points 3"]
) -> tuple[
    Float32[np.ndarray, "points 3"],
    Float32[np.ndarray, "points 3 3"],
    Bool[np.ndarray, "points"],
]:
    """Where points are in the camera's frame, the inverse derivative, and where it is sound."""
    camera, derivative = skin_trilinear(posed.nodes, points)
    volume = np.linalg.det(derivative)
    sound = (volume > 1 / rules.max_volume_ratio) & (volume < rules.max_volume_ratio)
    inverse = np.linalg.inv(np.where(sound[:, None, None], derivative, np.eye(3)))
    return camera, inverse.astype(np.float32), sound


def _surfel_of_key(key: Int64[np.ndarray, "pixels"]) -> Int64[np.ndarray, "pixels"]:
    return key & ((1 << SURFEL_BITS) - 1)


def _project_surfels(
    rules: RenderSettings, shot: PlayerInputs, posed: _PosedSurface, reach: float
) -> tuple[Float32[np.ndarray, "surfels 2"], Bool[np.ndarray, "surfels"]]:
    """Where surfels land, in pixels, and which of them are no farther than that outside."""
    depth = posed.positions[:, 2]
    safe = np.maximum(depth, np.float32(rules.near_plane_m))[:, None]
    place = posed.positions[:, :2] / safe * shot.focal + shot.center
    within = (place > -reach).all(axis=1) & (place < np.array(shot.size_px) + reach).all(axis=1)
    return place, within & (depth > rules.near_plane_m)


def _footprint_px(
    tables: PlayerTables, rules: RenderSettings, shot: PlayerInputs, posed: _PosedSurface
) -> int:
    """Pixels along the edge of every footprint: a surfel spacing where they are nearest."""
    _, near = _project_surfels(rules, shot, posed, 0.5 * rules.max_footprint_px)
    if not near.any():
        return 2
    spacing_px = shot.focal.max() * tables.surfels.spacing_m / posed.positions[near, 2].min()
    side = int(np.floor(spacing_px * rules.footprint_spacings + 0.999))
    return int(np.clip(side, 2, rules.max_footprint_px))


def _splat_surfels(
    tables: PlayerTables, rules: RenderSettings, shot: PlayerInputs, posed: _PosedSurface, side: int
) -> tuple[Int64[np.ndarray, "splats"], Int64[np.ndarray, "splats"], Float32[np.ndarray, "splats"]]:
    """Each visible surfel's cells with its key, and its depth if it may form the second layer.

    Cells count the pixels of a picture with a footprint's width around it.
    """
    width, height = shot.size_px
    place, seen = _project_surfels(rules, shot, posed, 0.5 * side)
    surfel = np.flatnonzero(seen)
    depth, place = posed.positions[surfel, 2], place[surfel]
    faces = posed.facing[surfel] < -depth * rules.min_facing_cosine
    near = shot.bones[0, 2, :3] @ tables.pelvis + shot.bones[0, 2, 3] - tables.reach_m
    code = (depth - near) / (2.0 * tables.reach_m) * (DEPTH_CODES - 1)
    code = np.clip(code, 0, DEPTH_CODES - 1).astype(np.int64)
    steps = int(rules.fold_depth_offset_m / (2.0 * tables.reach_m) * DEPTH_CODES)
    folded = posed.volume[surfel] < rules.fold_volume_ratio
    code = np.where(folded, np.minimum(code + steps, DEPTH_CODES - 1), code)
    key = (code << SURFEL_BITS) | surfel
    deep_enough = np.where(faces, depth, np.float32(0.0))

    first = np.floor(place - np.float32((side - 1) / 2)).astype(np.int64)
    steps = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 1, 2)
    column, row = np.moveaxis(first + steps + side, -1, 0)
    inside = (column >= 0) & (column < width + 2 * side) & (row >= 0) & (row < height + 2 * side)
    shape = inside.shape
    cell = (row * (width + 2 * side) + column)[inside]
    return cell, np.broadcast_to(key, shape)[inside], np.broadcast_to(deep_enough, shape)[inside]


def _fill_holes(
    keys: Int64[np.ndarray, "rows columns"], tables: PlayerTables, rules: RenderSettings, side: int
) -> Int64[np.ndarray, "height width"]:
    """Without the surroundings; what two pixels a footprint away overtop by far is filled."""
    here = slice(side, -side)
    across = np.maximum(keys[here, : -2 * side], keys[here, 2 * side :])
    along = np.maximum(keys[: -2 * side, here], keys[2 * side :, here])
    neighbours, keys = np.minimum(across, along), keys[here, here]
    steps = int(rules.hole_depth_m / (2.0 * tables.reach_m) * DEPTH_CODES)
    return np.where(keys - (steps << SURFEL_BITS) > neighbours, neighbours, keys)


def _ray_entries(
    tables: PlayerTables,
    rules: RenderSettings,
    shot: PlayerInputs,
    posed: _PosedSurface,
    pixel: Int64[np.ndarray, "pixels"],
    key: Int64[np.ndarray, "pixels"],
    before: _PreviousLayer | None,
) -> tuple[CanonicalRays, Float32[np.ndarray, "pixels"]]:
    """Rays behind covered pixels, and the depths at which they enter the hull."""
    surfels, surfel = tables.surfels, _surfel_of_key(key)
    row, column = np.divmod(pixel, shot.size_px[0])
    plane = (np.stack([column, row], axis=1) + 0.5 - shot.center) / shot.focal
    ray = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    ray = (ray / np.linalg.norm(ray, axis=1, keepdims=True)).astype(np.float32)

    camera, inverse, sound = _inverse_skinning(rules, posed, surfels.positions[surfel])
    along = (camera * ray).sum(axis=1)
    normal, thickness = surfels.normals[surfel], surfels.thickness[surfel]
    # where the skin is folded, the hull is looked at from straight above
    direction = np.where(sound[:, None], np.einsum("nij,nj->ni", inverse, ray), -normal)
    nearest = ray * along[:, None] - camera
    beside = np.einsum("nij,nj->ni", inverse, nearest)  # of the surfel, where the ray is closest
    beside = np.where(sound[:, None], beside, np.float32(0.0))
    falling = (normal * direction).sum(axis=1)
    shallow = np.float32(-0.5 * rules.min_cosine)
    hit = -(normal * beside).sum(axis=1) / np.minimum(falling, shallow)
    hit = np.where(falling < shallow, hit, 0.0)
    enter = along + np.clip(hit, -rules.max_entry_shift_m, rules.max_entry_shift_m)
    cosine = np.maximum(-falling, rules.min_cosine)
    most_lead = rules.max_entry_margin_m * compression_factor(rules, direction)
    lead = np.minimum(rules.entry_margin_m / cosine, most_lead)
    begin = enter - lead
    sine = 1.0 - falling**2 / (direction**2).sum(axis=1)
    bent = np.minimum(cosine, np.float32(rules.max_compression))
    length = thickness * np.minimum(
        (1.0 + rules.grazing_factor * sine) / bent, rules.max_lengthening
    )
    end = begin + np.minimum(length + lead, rules.max_segment_m)
    if before is not None:
        first = surfels.positions[before.surfel]
        apart = np.linalg.norm(surfels.positions[surfel] - first, axis=1)
        in_camera = np.linalg.norm(camera - skin_trilinear(posed.nodes, first)[0], axis=1)
        one_sheet = apart < in_camera * rules.same_sheet_ratio + rules.same_sheet_m
        later = np.minimum(np.maximum(begin, before.end), end)
        begin = np.where(one_sheet, later, begin)
    start = surfels.positions[surfel] + beside + (begin - along)[:, None] * direction
    rays = CanonicalRays(*(part.astype(np.float32) for part in (ray, begin, end, start, direction)))
    return rays, (enter * ray[:, 2]).astype(np.float32)

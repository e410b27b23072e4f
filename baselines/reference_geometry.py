"""Geometry of the reference player in numpy: posed skinning nodes, z-buffer, ray segments."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int64

from baselines.reference_skinning import PosedNodes, invert_matrices, skin_trilinear
from export.bake.traced_rays import RaySegments
from export.package.player_tables import (
    DEPTH_CODES,
    HOLE_SPACINGS,
    SURFEL_BITS,
    SURFEL_MASK,
    BrickTable,
    RenderSettings,
)


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


def compression_factor(
    settings: RenderSettings, direction: Float32[np.ndarray, "rays 3"]
) -> Float32[np.ndarray, "rays"]:
    """Factor, at most 1, by which lengths along rays shrink where the pose compresses space."""
    canonical_per_m = np.linalg.norm(direction, axis=1)
    return np.minimum(np.float32(settings.max_compression) / canonical_per_m, np.float32(1.0))


def invert_jacobians(
    settings: RenderSettings, jacobian: Float32[np.ndarray, "rays 3 3"]
) -> tuple[Float32[np.ndarray, "rays 3 3"], Bool[np.ndarray, "rays"]]:
    """Return inverse Jacobians, and which of them are sound; the others are arbitrary."""
    inverse, volume = invert_matrices(jacobian)
    sound = (volume > 1 / settings.max_volume_ratio) & (volume < settings.max_volume_ratio)
    return inverse, sound


def newton_correction(
    settings: RenderSettings, posed: PosedNodes, rays: CanonicalRays
) -> CanonicalRays:
    """Move canonical starts one Newton step onto their camera rays; update the directions."""
    camera, jacobian = skin_trilinear(posed, rays.start_canonical)
    inverse, sound = invert_jacobians(settings, jacobian)
    turned = np.einsum("nij,nj->ni", inverse, rays.direction_camera)
    inverse = inverse[sound]
    # x += J⁻¹ (t d - skinned(x)), at most `max_correction_m` long
    off = rays.begin[sound, None] * rays.direction_camera[sound] - camera[sound]
    shift = np.einsum("nij,nj->ni", inverse, off)
    length = np.linalg.norm(shift, axis=1, keepdims=True)
    start, direction = rays.start_canonical.copy(), rays.direction_canonical.copy()
    start[sound] += shift * np.minimum(settings.max_correction_m / np.maximum(length, 1e-10), 1.0)
    direction[sound] = turned[sound]
    return rays._replace(start_canonical=start, direction_canonical=direction)


def first_layer_segments(
    rays: CanonicalRays,
    posed: PosedNodes,
    bricks: BrickTable,
    settings: RenderSettings,
    samples: int,
) -> RaySegments:
    """March the first layer's rays to their ends, as if none ever became opaque.

    There is a ray for each covered pixel; `samples` are counted along
    `RenderSettings.sample_span_m`.
    """
    blocks = list(_march_blocks(rays, posed, settings, samples))
    number = np.concatenate([ray for ray, _, _ in blocks])
    rest = CanonicalRays(*map(np.concatenate, zip(*(b[1] for b in blocks), strict=True)))
    step_m = np.concatenate([step for _, _, step in blocks])
    order = np.argsort(number, kind="stable")
    return _segments_along(
        CanonicalRays(*(part[order] for part in rest)),
        step_m[order],
        np.searchsorted(number[order], np.arange(len(rays.begin) + 1)).astype(np.int64),
        bricks,
        (settings.block_samples, 0),
    )


def further_layer_segments(
    rays: CanonicalRays,
    ray_index: Int64[np.ndarray, "rays"],
    num_rays: int,
    bricks: BrickTable,
    count_and_layer: tuple[int, int],
) -> RaySegments:
    """Make one segment for each ray of a further layer.

    Ascending `ray_index` names the first layer's rays, of which there are `num_rays`; the last
    argument has a segment's samples and the layer's number, from 1.
    """
    step_m = (rays.end - rays.begin) / np.float32(count_and_layer[0])
    offsets = np.searchsorted(ray_index, np.arange(num_rays + 1)).astype(np.int64)
    return _segments_along(rays, step_m, offsets, bricks, count_and_layer)


def _segments_along(
    rays: CanonicalRays,
    step_m: Float32[np.ndarray, "segments"],
    ray_offsets: Int64[np.ndarray, "rays_and_one"],
    bricks: BrickTable,
    count_and_layer: tuple[int, int],
) -> RaySegments:
    """Express segments, which are grouped by ray already, in voxels of the brick grid."""
    (count, layer), voxel_m = count_and_layer, np.float32(bricks.voxel_m)
    return RaySegments(
        ray_offsets=ray_offsets,
        start=(rays.start_canonical - bricks.low) / voxel_m,
        slope=rays.direction_canonical * (step_m / voxel_m)[:, None],
        step_m=step_m,
        count=np.full(len(step_m), count, dtype=np.int32),
        layer=np.full(len(step_m), layer, dtype=np.int32),
    )


def append_layer(front: RaySegments, behind: RaySegments) -> RaySegments:
    """Append the segments of a layer behind to those of each ray."""
    rays = np.arange(front.num_rays)
    owners = [np.repeat(rays, np.diff(segments.ray_offsets)) for segments in (front, behind)]
    order = np.argsort(np.concatenate(owners), kind="stable")
    columns = {
        name: np.concatenate([getattr(front, name), getattr(behind, name)])[order]
        for name in ("start", "slope", "step_m", "count", "layer")
    }
    return RaySegments(ray_offsets=front.ray_offsets + behind.ray_offsets, **columns)


def _march_blocks(
    rays: CanonicalRays, posed: PosedNodes, settings: RenderSettings, samples: int
) -> Iterator[tuple[Int64[np.ndarray, "segments"], CanonicalRays, Float32[np.ndarray, "segments"]]]:
    """Yield for each block the numbers of unfinished rays, their remainders and their steps."""
    number, rest = np.arange(len(rays.begin)), rays
    for turn in range(settings.max_blocks * _block_multiple(settings, samples)):
        if turn > 0:
            rest = newton_correction(settings, posed, rest)
        step_m = np.minimum(
            (rest.end - rest.begin) / np.float32(settings.block_samples),
            _max_sample_spacing(settings, samples, turn, rest),
        )
        yield number, rest, step_m
        length = step_m * np.float32(settings.block_samples)
        rest = rest._replace(
            begin=rest.begin + length,
            start_canonical=rest.start_canonical + rest.direction_canonical * length[:, None],
        )
        going = rest.begin < rest.end - 1e-5
        number, rest = number[going], CanonicalRays(*(part[going] for part in rest))


def _block_multiple(settings: RenderSettings, samples: int) -> int:
    """Factor on both counts of blocks where more samples than usual are asked for."""
    return -(-samples // settings.samples)


def _max_sample_spacing(
    settings: RenderSettings, samples: int, turn: int, rays: CanonicalRays
) -> Float32[np.ndarray, "rays"]:
    """Upper bound on the distance between samples in the rays' `turn`-th block, metres."""
    multiple = _block_multiple(settings, samples)
    if turn > 0 and turn == settings.max_blocks * multiple - 1:
        return np.full(len(rays.begin), settings.max_segment_m, dtype=np.float32)
    doublings = max(0, turn + 1 - settings.uniform_blocks * multiple)
    nominal = settings.sample_span_m / samples * 2.0**doublings
    return np.float32(nominal) * compression_factor(settings, rays.direction_canonical)


EMPTY_PIXEL_KEY = 2**31 - 1
"""Z-buffer key of a pixel that no surfel covers."""


class SurfelFootprints(NamedTuple):
    """Surfels' footprints, one row for each cell that one covers.

    Attributes:
        spacing_px: Edge of a footprint before it is rounded up, pixels.
        side: Edge of a footprint, pixels.
        cell: Cells, numbered in a picture with a margin of `margin` pixels.
        depth: Depths of surfels that may form a further layer, metres; 0 for the others.
    """

    spacing_px: float
    side: int
    cell: Int64[np.ndarray, "splats"]
    key: Int64[np.ndarray, "splats"]
    depth: Float32[np.ndarray, "splats"]

    @property
    def margin(self) -> int:
        """Pixels about the picture from which holes in it are filled."""
        return HOLE_SPACINGS[-1] * self.side


def surfel_of_key(key: Int64[np.ndarray, "*pixels"]) -> Int64[np.ndarray, "*pixels"]:
    """Return the number of a key's surfel."""
    return key & SURFEL_MASK


def z_buffer(
    size_px: tuple[int, int],
    splats: SurfelFootprints,
    chosen: Bool[np.ndarray, "splats"] | None = None,
) -> Int64[np.ndarray, "rows columns"]:
    """Return the least key of every cell, of some splats or of all."""
    (width, height), margin = size_px, 2 * splats.margin
    buffer = np.full((height + margin, width + margin), EMPTY_PIXEL_KEY, dtype=np.int64)
    where = slice(None) if chosen is None else chosen
    np.minimum.at(buffer.reshape(-1), splats.cell[where], splats.key[where])
    return buffer


def fill_holes(
    keys: Int64[np.ndarray, "rows columns"],
    reach_m: float,
    settings: RenderSettings,
    splats: SurfelFootprints,
) -> Int64[np.ndarray, "height width"]:
    """Fill pixels that opposite ones, some spacings away, overtop by far; cut off the margin.

    `reach_m` is half the range of the depths that keys code, metres (`PlayerTables.reach_m`).
    """
    side, margin = splats.side, splats.margin
    here, filled = slice(margin, -margin), keys[margin:-margin, margin:-margin]
    steps = int(settings.hole_depth_m / (2.0 * reach_m) * DEPTH_CODES)
    for spacings in HOLE_SPACINGS:
        away = min(max(int(spacings * splats.spacing_px + 0.999), side), spacings * side)
        before = slice(margin - away, -margin - away)
        after = slice(margin + away, away - margin or None)
        across = np.maximum(keys[here, before], keys[here, after])
        along = np.maximum(keys[before, here], keys[after, here])
        neighbors = np.minimum(across, along)
        filled = np.where(filled - (steps << SURFEL_BITS) > neighbors, neighbors, filled)
    return filled

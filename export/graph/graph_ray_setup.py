"""Nodes that set up each pixel's ray at the proxy surface, trace a depth layer, and filter specks.

Specks are found by the median about pixels in which folded or crossing skin is seen.
"""

from dataclasses import dataclass

import numpy as np

from export.graph.graph_ray_march import (
    SegmentValues,
    composite_samples,
    compression_scale,
    march_segments,
)
from export.graph.graph_skinning import (
    CameraValues,
    GraphContext,
    PosedSurfels,
    SkinningCell,
    dot,
    invert_jacobian,
    skin_points,
    vector_table,
)
from export.graph.graph_zbuffer import SplatWindow, SurfelSplats
from export.graph.onnx_builder import GraphValue
from export.package.player_tables import (
    MAX_MEDIAN_DIFFERENCE,
    MAX_TRUSTED_COMPRESSION,
    MIN_FOOTPRINT_PX,
    MIN_MEDIAN_ALPHA,
    SURFEL_MASK,
)


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthLayer:
    """One depth layer: values of the graph, one entry or column a ray.

    Attributes:
        ray: Unit directions in the camera's frame.
        surfel: Surfel that each ray sees.
        canonical_position, camera_position: Its position in both frames, metres.
        color: Premultiplied.
        enter, end: Distances at which the ray enters the surface and ends, metres.
        doubtful: Whether the surfel is folded (its Jacobian is not inverted), compressed (in a
            close-up a metre along the ray crosses more than `MAX_TRUSTED_COMPRESSION` metres of
            canonical space) or seen from behind.
        blocks: With `GraphContext.traces` the ray of each block of samples, and their paths.
    """

    ray: GraphValue
    surfel: GraphValue
    canonical_position: GraphValue
    camera_position: GraphValue
    color: GraphValue
    transmittance: GraphValue
    enter: GraphValue
    end: GraphValue
    doubtful: GraphValue
    blocks: list[GraphValue]


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedProxySurface:
    """Surfels and skinning nodes in the camera's frame; whether it is near (`MIN_FOOTPRINT_PX`)."""

    surfels: PosedSurfels
    posed: GraphValue
    close_up: GraphValue


def pixel_rays(view: CameraValues, window: SplatWindow, pixel: GraphValue) -> GraphValue:
    """Return unit directions through the centers of some of the window's pixels (int32)."""
    width = window.width.cast(np.int32)
    row = pixel // width
    column = pixel - row * width
    x = column.cast(np.float32) + (window.left.cast(np.float32) + 0.5 - view.center[0])
    y = row.cast(np.float32) + (window.top.cast(np.float32) + 0.5 - view.center[1])
    x, y = x / view.focal[0], y / view.focal[1]
    scale = (x * x + y * y + 1.0).sqrt().reciprocal()
    return scale.graph.stack([x * scale, y * scale, scale])


def trace_depth_layer(
    context: GraphContext,
    surface: PosedProxySurface,
    keys: GraphValue,
    ray: GraphValue,
    front: DepthLayer | None,
) -> DepthLayer:
    """Trace unit rays of the camera's frame through one depth layer.

    Skinning is linearized about the surfel that a ray sees: the inverse Jacobian carries the ray to
    where it enters the surface. Where the skin is folded or compressed, look along its normal.
    `front` is the layer in front of the same rays; None for the first layer.
    """
    graph, surfel, surfels = context.graph, keys.bitwise_and(SURFEL_MASK), surface.surfels
    cell = SkinningCell(
        rows=[rows.gather(surfel) for rows in surfels.cell.rows],
        fraction=[fraction.gather(surfel) for fraction in surfels.cell.fraction],
    )
    camera, derivative = skin_points(context, surface.posed, cell)
    inverse = invert_jacobian(context, derivative)
    along_ray = inverse.apply(ray)  # canonical metres per metre
    normal = vector_table(context, "normal", surfel)
    far = dot(along_ray, along_ray) > MAX_TRUSTED_COMPRESSION**2
    trusted = inverse.trusted & (surface.close_up & far).logical_not()
    direction = graph.where(trusted, along_ray, -normal)
    along = dot(camera, ray)
    beside = graph.where(trusted, inverse.apply(ray * along - camera), 0.0)
    thickness = context.table_values["thickness"].gather(surfel)
    enter, begin, end = _segment_bounds(context, normal, thickness, direction, beside, along)
    canonical = vector_table(context, "position", surfel)
    if front is not None:
        begin = _begin_behind_front_layer(context, front, canonical, camera, begin, end)
    start = canonical + beside + direction * (begin - along)
    segment = SegmentValues(
        direction_camera=ray, begin=begin, end=end,
        start_canonical=start, direction_canonical=direction,
    )  # fmt: skip
    if front is not None or context.settings.max_blocks == 1:
        color, light, blocks = _composite_in_one_block(context, segment)
    else:
        color, light, blocks = march_segments(context, surface.posed, segment, surface.close_up)
    return DepthLayer(
        ray=ray,
        surfel=surfel,
        canonical_position=canonical,
        camera_position=camera,
        color=color,
        transmittance=light,
        enter=enter,
        end=end,
        doubtful=trusted.logical_not() | (dot(normal, direction) > 0.0),
        blocks=blocks,
    )


def _composite_in_one_block(
    context: GraphContext, segment: SegmentValues
) -> tuple[GraphValue, GraphValue, list[GraphValue]]:
    """Composite segments in one block; as `march_segments`."""
    settings, ones = context.settings, segment.begin * 0.0 + 1.0
    block = composite_samples(
        context, segment, ones, settings.further_layer_samples, settings.max_segment_m
    )
    graph = context.graph
    blocks = (
        [graph.range(graph.size(segment.begin).cast(np.int32)), graph.concatenate(block.path)]
        if context.traces
        else []
    )
    return block.color, block.transmittance, blocks


def _segment_bounds(
    context: GraphContext,
    normal: GraphValue,
    thickness: GraphValue,
    direction: GraphValue,
    beside: GraphValue,
    along: GraphValue,
) -> tuple[GraphValue, GraphValue, GraphValue]:
    """Return the distances at which rays enter the tangent plane, begin and end.

    In canonical space, `direction` is metres per metre along each ray, and `beside` the offset from
    each surfel to the closest point of its ray, `along` metres along it.
    """
    graph, settings = context.graph, context.settings
    falling = dot(normal, direction)
    shallow = -0.5 * settings.min_cosine
    hit = -dot(normal, beside) / falling.minimum(shallow)
    hit = graph.where(falling < shallow, hit, 0.0).clip(
        -settings.max_entry_shift_m, settings.max_entry_shift_m
    )
    enter = along + hit
    cosine = (-falling).maximum(settings.min_cosine)
    most_lead = compression_scale(context, direction) * settings.max_entry_margin_m
    # from behind, a ray has come through the body
    lead = graph.where(
        falling > 0.0, most_lead, (settings.entry_margin_m / cosine).minimum(most_lead)
    )
    sine = 1.0 - falling * falling / dot(direction, direction).maximum(1e-12)
    bent = cosine.minimum(settings.max_compression)  # compression at the surfel seldom lasts
    times = ((sine * settings.grazing_factor + 1.0) / bent).minimum(settings.max_lengthening)
    length = (thickness * times + lead).minimum(settings.max_segment_m)
    begin = enter - lead
    return enter, begin, begin + length


def _begin_behind_front_layer(
    context: GraphContext,
    before: DepthLayer,
    canonical: GraphValue,
    camera: GraphValue,
    begin: GraphValue,
    end: GraphValue,
) -> GraphValue:
    """Begin rays at the end of the front layer where both layers see one sheet."""
    settings = context.settings

    def apart(here: GraphValue, first: GraphValue) -> GraphValue:
        between = here - first
        return dot(between, between).sqrt()

    one_sheet = (
        apart(canonical, before.canonical_position)
        < apart(camera, before.camera_position) * settings.same_sheet_ratio + settings.same_sheet_m
    )
    later = begin.maximum(before.end).minimum(end)
    return context.graph.where(one_sheet, later, begin)


TAPS = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
"""Rows and columns, in halves of a footprint, of the pixels whose median is taken."""


def filter_specks(
    context: GraphContext,
    splats: SurfelSplats,
    cell: GraphValue,
    first: DepthLayer,
    channels: GraphValue,
) -> GraphValue:
    """Replace doubtful pixels, and specks behind the first layer, by the median about them.

    A pixel is doubtful where the pose folds the skin about its surfel, compresses it along the ray,
    or shows it from behind (`DepthLayer`): there a ray sees the surfel's own color or a wrong place
    of the cloth. A speck is a pixel whose ray passed the first layer, which should have stopped it:
    it lies inside of the avatar and differs from what is about it. Both are smaller than a
    footprint. `export.bake.traced_rays.filter_specks` says the same in numpy. Covered pixels have a
    z-buffer `cell` each, and `channels` premultiplied color and alpha.
    """
    graph, window = context.graph, splats.window
    passed = first.transmittance > context.settings.layer_min_transmittance
    covered = graph.range(graph.size(cell).cast(np.int32))
    suspect = covered.compress(first.doubtful | passed)
    half, rows_columns = splats.footprint_px // 2, np.array(TAPS, dtype=np.int64)
    rows, columns = (graph.constant(part) for part in rows_columns.T)
    steps = ((rows * window.stride + columns) * half).cast(np.int32)
    empty = graph.size(cell).cast(np.int32)
    numbers = (graph.full(graph.shape(window.cells), np.int32(0)) + empty).scatter(cell, covered)
    around = cell.gather(suspect).reshape(1, -1) + steps.reshape(-1, 1)
    around = numbers.gather(around.reshape(-1))
    nothing = graph.constant(np.zeros((4, 1), dtype=np.float32))
    taps = graph.concatenate([channels, nothing], axis=1).gather_columns(around.repeat_rows(4))
    nine = graph.split(taps.reshape(4, len(TAPS), -1), len(TAPS), axis=1)
    median = _median_of_nine(nine)
    apart = median - nine[len(TAPS) // 2]
    apart, median = apart.maximum(-apart).reshape(4, -1), median.reshape(4, -1)
    differs = apart.row(0).maximum(*(apart.row(k) for k in (1, 2, 3))) > MAX_MEDIAN_DIFFERENCE
    fine = splats.footprint_px > MIN_FOOTPRINT_PX - 1
    speck = (median.row(3) > MIN_MEDIAN_ALPHA) & differs & fine
    chosen = first.doubtful.gather(suspect) | speck
    there = suspect.compress(chosen).repeat_rows(4)
    return channels.scatter(there, median.compress_columns(chosen), axis=1)


def _median_of_nine(values: list[GraphValue]) -> GraphValue:
    """Return the median, by the least, the middle and the greatest of each three."""
    threes = [values[start : start + 3] for start in (0, 3, 6)]
    least = [a.minimum(b, c) for a, b, c in threes]
    middle = [_median_of_three(*three) for three in threes]
    greatest = [a.maximum(b, c) for a, b, c in threes]
    return _median_of_three(
        least[0].maximum(*least[1:]), _median_of_three(*middle), greatest[0].minimum(*greatest[1:])
    )


def _median_of_three(a: GraphValue, b: GraphValue, c: GraphValue) -> GraphValue:
    return a.minimum(b).maximum(a.maximum(b).minimum(c))

"""Nodes that splat surfels into z-buffers of the window that the surface covers."""

from dataclasses import dataclass

import numpy as np

from export.graph.graph_skinning import GraphContext, PosedSurfels, faces_camera
from export.graph.onnx_builder import GraphValue
from export.package.player_tables import DEPTH_CODES, HOLE_SPACINGS, SURFEL_BITS, SURFEL_MASK

EMPTY_KEY = np.int32(2**31 - 1)
"""Key of a pixel that no surfel covers."""
INFINITE_DEPTH_M = 1e6
"""Depth beyond all surfels, metres."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SplatWindow:
    """The part of the picture that the surface may cover, with a buffer and its border.

    Attributes:
        left, top: First pixel, int64.
        width, height: At least 1, int64.
        border: Pixels around it in the buffer, so that footprints stay inside, int64.
        stride: Pixels in a row of the buffer, int64.
        cells: Pixels in the buffer, int64; one more takes what is not drawn.
    """

    left: GraphValue
    top: GraphValue
    width: GraphValue
    height: GraphValue
    border: GraphValue
    stride: GraphValue
    cells: GraphValue


@dataclass(frozen=True, eq=False, kw_only=True)
class SurfelSplats:
    """Surfels on their way into a z-buffer: values of the graph, one entry a surfel.

    Attributes:
        spacing_px: Edge of a footprint before it is rounded up, pixels, scalar.
        footprint_px: Edge of every surfel's footprint, pixels, int64 scalar.
        cell: Upper left cell of the footprint in the buffer; `SplatWindow.cells` for none.
        key: Depth code and surfel number; the least one wins.
        depth: Metres along z.
    """

    window: SplatWindow
    spacing_px: GraphValue
    footprint_px: GraphValue
    cell: GraphValue
    key: GraphValue
    depth: GraphValue


def project_surfels(context: GraphContext, surfels: PosedSurfels) -> SurfelSplats:
    """Cull and project the surfels."""
    graph, view, settings = context.graph, context.camera, context.settings
    x, y, depth = surfels.camera_positions
    inverse = depth.maximum(settings.near_plane_m).reciprocal()
    u = x * inverse * view.focal[0] + view.center[0]
    v = y * inverse * view.focal[1] + view.center[1]
    before = depth > settings.near_plane_m
    width, height = view.width.cast(np.float32), view.height.cast(np.float32)

    def within(reach: GraphValue) -> GraphValue:
        beside = (u > -reach) & (v > -reach) & (u < width + reach) & (v < height + reach)
        return before & beside

    near = within(graph.constant(np.float32(0.5 * settings.max_footprint_px)))
    nearest = graph.where(near, depth, INFINITE_DEPTH_M).reduce_min()
    metres = context.tables.surfels.spacing_m * settings.footprint_spacings
    spacing_px = view.focal[0].maximum(view.focal[1]) * metres / nearest
    # the surfels nearest to the camera count, so that close-ups have no gaps
    side = _pixels(spacing_px).clip(2.0, float(settings.max_footprint_px)).cast(np.int64)
    reach = side.cast(np.float32) * 0.5
    seen = within(reach)
    window = _window(context, u, v, side)
    middle = (side.cast(np.float32) - 1.0) * 0.5 - window.border.cast(np.float32)
    column = (u - (window.left.cast(np.float32) + middle)).cast(np.int32)
    row = (v - (window.top.cast(np.float32) + middle)).cast(np.int32)
    cell = row * window.stride.cast(np.int32) + column
    number = graph.range(graph.constant(np.int32(len(context.tables.surfels))))
    return SurfelSplats(
        window=window,
        spacing_px=spacing_px,
        footprint_px=side,
        cell=graph.where(seen, cell, window.cells.cast(np.int32)),
        key=_depth_code(context, depth) * (1 << SURFEL_BITS) + number,
        depth=depth,
    )


def _window(context: GraphContext, u: GraphValue, v: GraphValue, side: GraphValue) -> SplatWindow:
    """Bound all projected points, seen or not, within the picture."""
    border, reach = side * (HOLE_SPACINGS[-1] + 1) + 2, side.cast(np.float32) * 0.5

    def extent(places: GraphValue, size: GraphValue) -> tuple[GraphValue, GraphValue]:
        inside = places.maximum(-reach).minimum(size.cast(np.float32) + reach)
        first = (inside.reduce_min() - reach).floor().cast(np.int64)
        last = (inside.reduce_max() + (reach + 1.0)).floor().cast(np.int64)
        first = first.maximum(0).minimum(size - 1)
        return first, last.minimum(size).maximum(first + 1) - first

    left, width = extent(u, context.camera.width)
    top, height = extent(v, context.camera.height)
    stride = width + border * 2
    return SplatWindow(
        left=left,
        top=top,
        width=width,
        height=height,
        border=border,
        stride=stride,
        cells=stride * (height + border * 2),
    )


def _depth_code(context: GraphContext, depth: GraphValue) -> GraphValue:
    """Depth as an integer of 14 bits, in a window about the pelvis."""
    tables, root = context.tables, context.camera.bones.row(0)
    pelvis = root.row(11)
    for axis in range(3):
        pelvis = pelvis + root.row(8 + axis) * float(tables.pelvis[axis])
    near = pelvis - tables.reach_m
    steps = (depth - near) * ((DEPTH_CODES - 1) / (2.0 * tables.reach_m))
    return steps.clip(0.0, DEPTH_CODES - 1.0).cast(np.int32)


def _pixels(length_px: GraphValue) -> GraphValue:
    """Round a length up to whole pixels."""
    return (length_px + 0.999).floor()


def nearest_keys(context: GraphContext, splats: SurfelSplats) -> GraphValue:
    """Return the least key of each of the window's pixels, row after row.

    Where the skin is stretched, surfels lie farther apart than a footprint is wide: a pixel that
    two opposite ones, `HOLE_SPACINGS` away, overtop by far is a hole, and filled.
    """
    window = splats.window
    buffer = _scatter_keys(context, window, splats.cell, splats.key)
    buffer = _min_over_footprint(context, buffer.slice_axes([0], [window.cells]), splats)
    # footprints lie to the lower right of their cells, so pixels begin a footprint earlier
    begin = (window.stride + 1) * (1 - splats.footprint_px + window.border)

    def shifted(by: GraphValue | int) -> GraphValue:
        return buffer.slice_axes([begin + by], [begin + by + window.stride * window.height])

    keys = shifted(0)
    steps = int(context.settings.hole_depth_m / (2.0 * context.tables.reach_m) * DEPTH_CODES)
    side = splats.footprint_px
    for spacings in HOLE_SPACINGS:
        away = _pixels(splats.spacing_px * float(spacings)).minimum(1e6).cast(np.int64)
        column = away.maximum(side).minimum(side * spacings)
        row = column * window.stride
        across = shifted(-column).maximum(shifted(column))
        along = shifted(-row).maximum(shifted(row))
        neighbors = across.minimum(along)
        hole = (keys - (steps << SURFEL_BITS)) > neighbors
        keys = context.graph.where(hole, neighbors, keys)
    rows = keys.reshape(-1, window.stride)
    return rows.slice_axes([0, 0], [window.height, window.width]).reshape(-1)


def _scatter_keys(
    context: GraphContext, window: SplatWindow, cell: GraphValue, key: GraphValue
) -> GraphValue:
    empty = context.graph.full(context.graph.shape(window.cells + 1), EMPTY_KEY)
    return empty.scatter(cell, key, reduction="min")


def _min_over_footprint(
    context: GraphContext, buffer: GraphValue, splats: SurfelSplats
) -> GraphValue:
    """Return the least of the footprint right of and below each cell; drop the last cells."""
    stride = splats.window.stride
    last = np.iinfo(np.int64).max

    def once(_: GraphValue, state: list[GraphValue]) -> list[GraphValue]:
        cells = state[0]
        cells = cells.slice_axes([0], [-1]).minimum(cells.slice_axes([1], [last]))
        return [cells.slice_axes([0], [-stride]).minimum(cells.slice_axes([stride], [last]))]

    return context.graph.loop(splats.footprint_px - 1, [buffer], once)[0]


@dataclass(frozen=True, eq=False, kw_only=True)
class HiddenSplats:
    """Surfels that may lie behind the first layer, on their way into further z-buffers.

    One entry for each pixel of a footprint: values of the graph, as in `SurfelSplats`.
    """

    window: SplatWindow
    cell: GraphValue
    key: GraphValue
    depth: GraphValue


def depth_limits(
    context: GraphContext, window: SplatWindow, cell: GraphValue, depth: GraphValue
) -> GraphValue:
    """Return a buffer of depths, metres along z; `INFINITE_DEPTH_M` in cells that have none."""
    empty = context.graph.full(context.graph.shape(window.cells + 1), np.float32(INFINITE_DEPTH_M))
    return empty.scatter(cell, depth)


def hidden_splats(
    context: GraphContext,
    posed: GraphValue,
    surfels: PosedSurfels,
    splats: SurfelSplats,
    limits: GraphValue,
) -> HiddenSplats:
    """Select surfels that face the camera and are deeper than a limit on their footprint.

    `limits` are the second layer's (`depth_limits`); those of later layers are deeper.
    """
    graph, window, side = context.graph, splats.window, splats.footprint_px
    lowest = _min_over_footprint(context, limits, splats) - sheet_slack_m(context)
    lost = (side - 1) * (window.stride + 1)
    lowest = graph.concatenate(
        [lowest, graph.full(graph.shape(lost), np.float32(INFINITE_DEPTH_M))]
    )
    number = graph.range(graph.constant(np.int32(len(context.tables.surfels))))
    number = number.compress(splats.depth > lowest.gather(splats.cell))
    number = number.compress(faces_camera(context, posed, surfels, number))
    first, key, depth = (
        value.gather(number).reshape(1, -1) for value in (splats.cell, splats.key, splats.depth)
    )
    offset = graph.range(side * side).reshape(-1, 1)
    down = offset // side
    covered = first + (down * window.stride + (offset - down * side)).cast(np.int32)
    copies = graph.shape(side * side, 1)
    key, depth = (graph.node("Expand", v, copies).reshape(-1) for v in (key, depth))
    return HiddenSplats(window=window, cell=covered.reshape(-1), key=key, depth=depth)


def sheet_slack_m(context: GraphContext) -> float:
    """Return how much nearer than a limit surfels of other sheets may be, metres, at least 0."""
    return max(context.settings.layer_gap_m - context.settings.other_sheet_gap_m, 0.0)


def keys_behind_limits(
    context: GraphContext,
    surfels: PosedSurfels,
    hidden: HiddenSplats,
    limits: GraphValue,
    cell: GraphValue,
    front_surfel: GraphValue,
) -> GraphValue:
    """Return the least key deeper than the limits, for some cells of the buffer.

    `front_surfel` is the surfel of the layer in front, for each of these cells.
    """
    graph, window = context.graph, hidden.window
    limit = limits.gather(hidden.cell)
    near = graph.range(graph.size(hidden.key).cast(np.int32))
    near = near.compress(hidden.depth > limit - sheet_slack_m(context))
    cells, keys = hidden.cell.gather(near), hidden.key.gather(near)
    passed = graph.full(graph.shape(window.cells + 1), np.int32(0)).scatter(cell, front_surfel)
    same = _same_sheet(context, surfels, keys.bitwise_and(SURFEL_MASK), passed.gather(cells))
    deeper = hidden.depth.gather(near) > limit.gather(near)
    cells = graph.where(deeper, cells, graph.where(same, window.cells.cast(np.int32), cells))
    return _scatter_keys(context, window, cells, keys).gather(cell)


def _same_sheet(
    context: GraphContext, surfels: PosedSurfels, one: GraphValue, other: GraphValue
) -> GraphValue:
    """Tell which pairs of surfels are about as close in canonical space as they are posed."""
    settings = context.settings

    def apart(columns: list[GraphValue]) -> GraphValue:
        between = [column.gather(one) - column.gather(other) for column in columns]
        squares = [part * part for part in between]
        return (squares[0] + squares[1] + squares[2]).sqrt()

    canonical = [context.table_values[f"position_{letter}"] for letter in "xyz"]
    return (
        apart(canonical)
        < apart(surfels.camera_positions) * settings.same_sheet_ratio + settings.same_sheet_m
    )

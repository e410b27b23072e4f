"""Nodes that find out which surfel each pixel sees: a z-buffer of the part that the surface covers."""

from dataclasses import dataclass

import numpy as np

from export.graph.graph_context import GraphContext, VectorValue, dot
from export.graph.graph_skinning import PosedNodeValues, PosedSurfels, faces_camera
from export.graph.onnx_builder import GraphValue
from export.package.player_tables import DEPTH_CODES, SURFEL_BITS

EMPTY_KEY = np.int32(2**31 - 1)
"""Key of a pixel that no surfel covers."""
INFINITE_DEPTH_M = 1e6
"""Metres: deeper than anything."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SplatWindow:
    """The part of the picture that the surface may cover, and a buffer with a border around it.

    Attributes:
        left, top: Where it begins, pixels, int64.
        width, height: At least 1, int64.
        border: Pixels around it in the buffer, so that footprints never leave it, int64.
        stride: Pixels in a row of the buffer, int64.
        cells: Pixels in the buffer, int64; there is one more for what is not drawn.
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
        window: Where it is.
        side: Pixels along the edge of every surfel's footprint, int64 scalar.
        cell: Upper left pixel of its footprint in the buffer; `SplatWindow.cells` for none.
        key: Depth code and surfel number, to be minimised.
        depth: Metres along z.
    """

    window: SplatWindow
    footprint_px: GraphValue
    cell: GraphValue
    key: GraphValue
    depth: GraphValue


def project_surfels(context: GraphContext, surfels: PosedSurfels) -> SurfelSplats:
    """Culls and projects the surfels."""
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
    side = _footprint_size(context, graph.where(near, depth, INFINITE_DEPTH_M).reduce_min())
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
        footprint_px=side,
        cell=graph.where(seen, cell, window.cells.cast(np.int32)),
        key=_offset_folded(context, _depth_code(context, depth), surfels) * (1 << SURFEL_BITS)
        + number,
        depth=depth,
    )


def _window(context: GraphContext, u: GraphValue, v: GraphValue, side: GraphValue) -> SplatWindow:
    """About all points, whether they are seen or not."""
    border, reach = side * 2 + 2, side.cast(np.float32) * 0.5

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


def _offset_folded(context: GraphContext, code: GraphValue, surfels: PosedSurfels) -> GraphValue:
    """Depth codes, with folded surfels moved behind their neighbours."""
    settings = context.settings
    if settings.fold_depth_offset_m == 0.0:
        return code
    steps = int(settings.fold_depth_offset_m / (2.0 * context.tables.reach_m) * DEPTH_CODES)
    behind = (code + steps).minimum(DEPTH_CODES - 1)
    return context.graph.where(surfels.folded, behind, code)


def _footprint_size(context: GraphContext, nearest: GraphValue) -> GraphValue:
    """Pixels along the edge of every surfel's footprint, an int64 scalar of at least 2.

    It follows the spacing of the surfels where they are nearest to the camera, so that one does
    not see through the surface in a close-up.
    """
    settings, focal = context.settings, context.camera.focal
    spacing_px = focal[0].maximum(focal[1]) * context.tables.surfels.spacing_m / nearest
    side = (spacing_px * settings.footprint_spacings + 0.999).floor()
    return side.clip(2.0, float(settings.max_footprint_px)).cast(np.int64)


def nearest_keys(context: GraphContext, splats: SurfelSplats) -> GraphValue:
    """The least key of each of the window's pixels, row after row.

    Where the skin is stretched surfels lie farther apart than a footprint is wide: what two of them
    on opposite sides, a footprint away, overtop by far is a hole, and filled.
    """
    window = splats.window
    buffer = _scatter_keys(context, window, splats.cell, splats.key)
    buffer = _min_over_footprint(context, buffer.slice_axes([0], [window.cells]), splats)
    # footprints lie to the lower right of their cells, so what is spread begins so much later
    begin = (window.stride + 1) * (1 - splats.footprint_px + window.border)

    def shifted(by: GraphValue | int) -> GraphValue:
        return buffer.slice_axes([begin + by], [begin + by + window.stride * window.height])

    keys = shifted(0)
    row = splats.footprint_px * window.stride
    across = shifted(-splats.footprint_px).maximum(shifted(splats.footprint_px))
    along = shifted(-row).maximum(shifted(row))
    neighbours = across.minimum(along)
    steps = int(context.settings.hole_depth_m / (2.0 * context.tables.reach_m) * DEPTH_CODES)
    hole = (keys - (steps << SURFEL_BITS)) > neighbours
    keys = context.graph.where(hole, neighbours, keys)
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
    """The least of a footprint's cells right and below of each; the last ones are left out."""
    stride = splats.window.stride
    last = np.iinfo(np.int64).max

    def once(_: GraphValue, state: list[GraphValue]) -> list[GraphValue]:
        cells = state[0]
        cells = cells.slice_axes([0], [-1]).minimum(cells.slice_axes([1], [last]))
        return [cells.slice_axes([0], [-stride]).minimum(cells.slice_axes([stride], [last]))]

    return context.graph.loop(splats.footprint_px - 1, [buffer], once)[0]


@dataclass(frozen=True, eq=False, kw_only=True)
class HiddenSplats:
    """Surfels that may lie behind something, on their way into further z-buffers.

    One entry for each pixel of a footprint: values of the graph.

    Attributes:
        window: Where the buffers are.
        cell: Pixel of the buffer.
        key: As in `SurfelSplats`.
        depth: Metres along z.
    """

    window: SplatWindow
    cell: GraphValue
    key: GraphValue
    depth: GraphValue


def depth_limits(
    context: GraphContext, window: SplatWindow, cell: GraphValue, depth: GraphValue
) -> GraphValue:
    """A buffer of depths, metres along z: those given, and nowhere else anything is deeper."""
    empty = context.graph.full(context.graph.shape(window.cells + 1), np.float32(INFINITE_DEPTH_M))
    return empty.scatter(cell, depth)


def hidden_splats(
    context: GraphContext,
    posed: PosedNodeValues,
    surfels: PosedSurfels,
    splats: SurfelSplats,
    limits: GraphValue,
) -> HiddenSplats:
    """Surfels that are deeper than a limit somewhere on their footprint, and face the camera.

    Args:
        context: What is drawn.
        posed: The skin's nodes in the camera's frame.
        surfels: All of them.
        splats: The same, projected.
        limits: The first ones (`depth_limits`); later ones only grow deeper.
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
    """By how much other sheets' surfels may fall short of a limit, metres; 0 if by nothing."""
    return max(context.settings.layer_gap_m - context.settings.other_sheet_gap_m, 0.0)


def keys_behind_limits(
    context: GraphContext,
    surfels: PosedSurfels,
    hidden: HiddenSplats,
    limits: GraphValue,
    cell: GraphValue,
    front_surfel: GraphValue,
) -> GraphValue:
    """The least key of what lies deeper than the limits, for some cells of the buffer.

    Args:
        context: What is drawn.
        surfels: The surface.
        hidden: What comes into question.
        limits: As `depth_limits` makes them.
        cell: Cells of the buffer.
        before: The surfel that was seen in each of them.
    """
    graph, window = context.graph, hidden.window
    limit = limits.gather(hidden.cell)
    cells, keys = hidden.cell, hidden.key
    if sheet_slack_m(context) > 0.0:
        near = graph.range(graph.size(keys).cast(np.int32))
        near = near.compress(hidden.depth > limit - sheet_slack_m(context))
        cells, keys = cells.gather(near), keys.gather(near)
        passed = graph.full(graph.shape(window.cells + 1), np.int32(0)).scatter(cell, front_surfel)
        same = _same_sheet(
            context, surfels, keys.bitwise_and((1 << SURFEL_BITS) - 1), passed.gather(cells)
        )
        deeper = hidden.depth.gather(near) > limit.gather(near)
        cells = graph.where(deeper, cells, graph.where(same, window.cells.cast(np.int32), cells))
    else:
        cells = graph.where(hidden.depth > limit, cells, window.cells.cast(np.int32))
    return _scatter_keys(context, window, cells, keys).gather(cell)


def _same_sheet(
    context: GraphContext, surfels: PosedSurfels, one: GraphValue, other: GraphValue
) -> GraphValue:
    """Whether pairs of surfels are no farther apart in canonical space than as they are posed."""
    settings = context.settings

    def apart(columns: VectorValue) -> GraphValue:
        between = [column.gather(one) - column.gather(other) for column in columns]
        return dot(between, between).sqrt()

    canonical = [context.table_values[f"position_{letter}"] for letter in "xyz"]
    return (
        apart(canonical)
        < apart(surfels.camera_positions) * settings.same_sheet_ratio + settings.same_sheet_m
    )

"""Nodes that find out which surfel each pixel sees: a z-buffer of the part that the hull covers."""

from dataclasses import dataclass

import numpy as np

from export.columns import Vector, dot
from export.nodes import Value
from export.posing import Posed
from export.scene import Scene
from export.surfels import Surfels, faces_camera
from export.tables import DEPTH_STEPS, SURFEL_BITS

FAR = np.int32(2**31 - 1)
"""Key of a pixel that no surfel covers."""
NOWHERE = 1e6
"""Metres: deeper than anything."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Window:
    """The part of the picture that the hull may cover, and a buffer with a border around it.

    Attributes:
        left, top: Where it begins, pixels, int64.
        width, height: At least 1, int64.
        border: Pixels around it in the buffer, so that footprints never leave it, int64.
        stride: Pixels in a row of the buffer, int64.
        cells: Pixels in the buffer, int64; there is one more for what is not drawn.
    """

    left: Value
    top: Value
    width: Value
    height: Value
    border: Value
    stride: Value
    cells: Value


@dataclass(frozen=True, eq=False, kw_only=True)
class Splats:
    """Surfels on their way into a z-buffer: values of the graph, one entry a surfel.

    Attributes:
        window: Where it is.
        side: Pixels along the edge of every surfel's footprint, int64 scalar.
        cell: Upper left pixel of its footprint in the buffer; `Window.cells` for none.
        key: Depth code and surfel number, to be minimised.
        depth: Metres along z.
    """

    window: Window
    side: Value
    cell: Value
    key: Value
    depth: Value


def splat(scene: Scene, surfels: Surfels) -> Splats:
    """Culls and projects the surfels."""
    graph, view, rules = scene.graph, scene.view, scene.rules
    x, y, depth = surfels.camera
    inverse = depth.maximum(rules.nearest_m).reciprocal()
    u = x * inverse * view.focal[0] + view.center[0]
    v = y * inverse * view.focal[1] + view.center[1]
    before = depth > rules.nearest_m
    width, height = view.width.cast(np.float32), view.height.cast(np.float32)

    def within(reach: Value) -> Value:
        beside = (u > -reach) & (v > -reach) & (u < width + reach) & (v < height + reach)
        return before & beside

    near = within(graph.constant(np.float32(0.5 * rules.largest_footprint_px)))
    side = _footprint(scene, graph.where(near, depth, NOWHERE).smallest())
    reach = side.cast(np.float32) * 0.5
    seen = within(reach)
    window = _window(scene, u, v, side)
    middle = (side.cast(np.float32) - 1.0) * 0.5 - window.border.cast(np.float32)
    column = (u - (window.left.cast(np.float32) + middle)).cast(np.int32)
    row = (v - (window.top.cast(np.float32) + middle)).cast(np.int32)
    cell = row * window.stride.cast(np.int32) + column
    number = graph.range(graph.constant(np.int32(len(scene.tables.surfels))))
    return Splats(
        window=window,
        side=side,
        cell=graph.where(seen, cell, window.cells.cast(np.int32)),
        key=_set_back(scene, _depth_code(scene, depth), surfels) * (1 << SURFEL_BITS) + number,
        depth=depth,
    )


def _window(scene: Scene, u: Value, v: Value, side: Value) -> Window:
    """About all points, whether they are seen or not."""
    border, reach = side * 2 + 2, side.cast(np.float32) * 0.5

    def extent(places: Value, size: Value) -> tuple[Value, Value]:
        inside = places.maximum(-reach).minimum(size.cast(np.float32) + reach)
        first = (inside.smallest() - reach).floor().cast(np.int64)
        last = (inside.largest() + (reach + 1.0)).floor().cast(np.int64)
        first = first.maximum(0).minimum(size - 1)
        return first, last.minimum(size).maximum(first + 1) - first

    left, width = extent(u, scene.view.width)
    top, height = extent(v, scene.view.height)
    stride = width + border * 2
    return Window(
        left=left,
        top=top,
        width=width,
        height=height,
        border=border,
        stride=stride,
        cells=stride * (height + border * 2),
    )


def _depth_code(scene: Scene, depth: Value) -> Value:
    """Depth as an integer of 14 bits, in a window about the pelvis."""
    tables, root = scene.tables, scene.view.bones.row(0)
    pelvis = root.row(11)
    for axis in range(3):
        pelvis = pelvis + root.row(8 + axis) * float(tables.pelvis[axis])
    near = pelvis - tables.reach_m
    steps = (depth - near) * ((DEPTH_STEPS - 1) / (2.0 * tables.reach_m))
    return steps.clipped(0.0, DEPTH_STEPS - 1.0).cast(np.int32)


def _set_back(scene: Scene, code: Value, surfels: Surfels) -> Value:
    """Depth codes, with folded surfels moved behind their neighbours."""
    rules = scene.rules
    if rules.fold_setback_m == 0.0:
        return code
    steps = int(rules.fold_setback_m / (2.0 * scene.tables.reach_m) * DEPTH_STEPS)
    behind = (code + steps).minimum(DEPTH_STEPS - 1)
    return scene.graph.where(surfels.folded, behind, code)


def _footprint(scene: Scene, nearest: Value) -> Value:
    """Pixels along the edge of every surfel's footprint, an int64 scalar of at least 2.

    It follows the spacing of the surfels where they are nearest to the camera, so that one does
    not see through the hull in a close-up.
    """
    rules, focal = scene.rules, scene.view.focal
    spacing_px = focal[0].maximum(focal[1]) * scene.tables.surfels.spacing_m / nearest
    side = (spacing_px * rules.footprint_spacings + 0.999).floor()
    return side.clipped(2.0, float(rules.largest_footprint_px)).cast(np.int64)


def nearest_keys(scene: Scene, splats: Splats) -> Value:
    """The least key of each of the window's pixels, row after row.

    Where the skin is stretched surfels lie farther apart than a footprint is wide: what two of them
    on opposite sides, a footprint away, overtop by far is a hole, and filled.
    """
    window = splats.window
    buffer = _scattered(scene, window, splats.cell, splats.key)
    buffer = _spread(scene, buffer.slices([0], [window.cells]), splats)
    # footprints lie to the lower right of their cells, so what is spread begins so much later
    begin = (window.stride + 1) * (1 - splats.side + window.border)

    def shifted(by: Value | int) -> Value:
        return buffer.slices([begin + by], [begin + by + window.stride * window.height])

    keys = shifted(0)
    row = splats.side * window.stride
    across = shifted(-splats.side).maximum(shifted(splats.side))
    along = shifted(-row).maximum(shifted(row))
    neighbours = across.minimum(along)
    steps = int(scene.rules.hole_m / (2.0 * scene.tables.reach_m) * DEPTH_STEPS)
    hole = (keys - (steps << SURFEL_BITS)) > neighbours
    keys = scene.graph.where(hole, neighbours, keys)
    rows = keys.reshaped(-1, window.stride)
    return rows.slices([0, 0], [window.height, window.width]).reshaped(-1)


def _scattered(scene: Scene, window: Window, cell: Value, key: Value) -> Value:
    empty = scene.graph.filled(scene.graph.shape(window.cells + 1), FAR)
    return empty.scattered(cell, key, reduction="min")


def _spread(scene: Scene, buffer: Value, splats: Splats) -> Value:
    """The least of a footprint's cells right and below of each; the last ones are left out."""
    stride = splats.window.stride
    last = np.iinfo(np.int64).max

    def once(_: Value, state: list[Value]) -> list[Value]:
        cells = state[0]
        cells = cells.slices([0], [-1]).minimum(cells.slices([1], [last]))
        return [cells.slices([0], [-stride]).minimum(cells.slices([stride], [last]))]

    return scene.graph.loop(splats.side - 1, [buffer], once)[0]


@dataclass(frozen=True, eq=False, kw_only=True)
class Hidden:
    """Surfels that may lie behind something, on their way into further z-buffers.

    One entry for each pixel of a footprint: values of the graph.

    Attributes:
        window: Where the buffers are.
        cell: Pixel of the buffer.
        key: As in `Splats`.
        depth: Metres along z.
    """

    window: Window
    cell: Value
    key: Value
    depth: Value


def limits_at(scene: Scene, window: Window, cell: Value, depth: Value) -> Value:
    """A buffer of depths, metres along z: those given, and nowhere else anything is deeper."""
    empty = scene.graph.filled(scene.graph.shape(window.cells + 1), np.float32(NOWHERE))
    return empty.scattered(cell, depth)


def hidden_by(
    scene: Scene, posed: Posed, surfels: Surfels, splats: Splats, limits: Value
) -> Hidden:
    """Surfels that are deeper than a limit somewhere on their footprint, and face the camera.

    Args:
        scene: What is drawn.
        posed: The skin's nodes in the camera's frame.
        surfels: All of them.
        splats: The same, projected.
        limits: The first ones (`limits_at`); later ones only grow deeper.
    """
    graph, window, side = scene.graph, splats.window, splats.side
    lowest = _spread(scene, limits, splats) - slack_of(scene)
    lost = (side - 1) * (window.stride + 1)
    lowest = graph.concatenated([lowest, graph.filled(graph.shape(lost), np.float32(NOWHERE))])
    number = graph.range(graph.constant(np.int32(len(scene.tables.surfels))))
    number = number.compressed(splats.depth > lowest.take(splats.cell))
    number = number.compressed(faces_camera(scene, posed, surfels, number))
    first, key, depth = (
        value.take(number).reshaped(1, -1) for value in (splats.cell, splats.key, splats.depth)
    )
    offset = graph.range(side * side).reshaped(-1, 1)
    down = offset // side
    covered = first + (down * window.stride + (offset - down * side)).cast(np.int32)
    copies = graph.shape(side * side, 1)
    key, depth = (graph.node("Expand", v, copies).reshaped(-1) for v in (key, depth))
    return Hidden(window=window, cell=covered.reshaped(-1), key=key, depth=depth)


def slack_of(scene: Scene) -> float:
    """By how much other sheets' surfels may fall short of a limit, metres; 0 if by nothing."""
    return max(scene.rules.gap_m - scene.rules.sheet_gap_m, 0.0)


def keys_behind(
    scene: Scene, surfels: Surfels, hidden: Hidden, limits: Value, cell: Value, before: Value
) -> Value:
    """The least key of what lies deeper than the limits, for some cells of the buffer.

    Args:
        scene: What is drawn.
        surfels: The hull.
        hidden: What comes into question.
        limits: As `limits_at` makes them.
        cell: Cells of the buffer.
        before: The surfel that was seen in each of them.
    """
    graph, window = scene.graph, hidden.window
    limit = limits.take(hidden.cell)
    cells, keys = hidden.cell, hidden.key
    if slack_of(scene) > 0.0:
        near = graph.range(graph.size(keys).cast(np.int32))
        near = near.compressed(hidden.depth > limit - slack_of(scene))
        cells, keys = cells.take(near), keys.take(near)
        passed = graph.filled(graph.shape(window.cells + 1), np.int32(0)).scattered(cell, before)
        same = _one_sheet(scene, surfels, keys.masked((1 << SURFEL_BITS) - 1), passed.take(cells))
        deeper = hidden.depth.take(near) > limit.take(near)
        cells = graph.where(deeper, cells, graph.where(same, window.cells.cast(np.int32), cells))
    else:
        cells = graph.where(hidden.depth > limit, cells, window.cells.cast(np.int32))
    return _scattered(scene, window, cells, keys).take(cell)


def _one_sheet(scene: Scene, surfels: Surfels, one: Value, other: Value) -> Value:
    """Whether pairs of surfels are no farther apart in canonical space than as they are posed."""
    rules = scene.rules

    def apart(columns: Vector) -> Value:
        between = [column.take(one) - column.take(other) for column in columns]
        return dot(between, between).sqrt()

    canonical = [scene.columns[f"position_{letter}"] for letter in "xyz"]
    return apart(canonical) < apart(surfels.camera) * rules.same_share + rules.same_m

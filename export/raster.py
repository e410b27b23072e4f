"""Nodes that pose the hull and find out which surfel each pixel sees."""

from dataclasses import dataclass

import numpy as np

from export.columns import Matrix, Vector, adjugate, applied, dot
from export.nodes import Value
from export.posing import Posed, carried, determinant, pose_nodes, sound
from export.scene import Scene
from export.tables import DEPTH_STEPS, SURFEL_BITS

FAR = np.int32(2**31 - 1)
"""Key of a pixel that no surfel covers."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Hull:
    """The hull in one pose: values of the graph, one entry a surfel.

    Attributes:
        posed: What carried it.
        surfel: Surfel numbers.
        canonical, normal: Canonical positions and normals.
        camera: Positions in the camera's frame.
        inverse: Inverse of the derivative of that, 3×3.
        from_eye: `inverse` times `camera`: the ray from the eye, seen in canonical space.
        sound: Whether the derivative can be inverted.
    """

    posed: Posed
    surfel: Value
    canonical: Vector
    normal: Vector
    camera: Vector
    inverse: Matrix
    from_eye: Vector
    sound: Value


@dataclass(frozen=True, eq=False, kw_only=True)
class Splats:
    """Surfels that may be seen, each once for every pixel of its footprint.

    Attributes:
        pixel: Which pixel; `View.pixels` for none.
        key: Depth code and surfel number, to be minimised.
        depth: Metres along z; 0 for a surfel that the second layer leaves out.
    """

    pixel: Value
    key: Value
    depth: Value


def pose_hull(scene: Scene) -> Hull:
    """Carries every surfel into the camera's frame, and inverts the map about it."""
    columns, posed = scene.columns, pose_nodes(scene)
    canonical = [columns[f"position_{letter}"] for letter in "xyz"]
    camera, derivative = carried(scene, posed, canonical)
    cofactors = adjugate(derivative)
    volume = determinant(derivative, cofactors)
    scale = volume.reciprocal()
    inverse = [[entry * scale for entry in row] for row in cofactors]
    return Hull(
        posed=posed,
        surfel=columns["surfel"],
        canonical=canonical,
        normal=[columns[f"normal_{letter}"] for letter in "xyz"],
        camera=camera,
        inverse=inverse,
        from_eye=applied(inverse, camera),
        sound=sound(scene, volume),
    )


def splat(scene: Scene, hull: Hull) -> Splats:
    """Culls and projects the surfels and spreads them over their footprints."""
    graph, view, rules = scene.graph, scene.view, scene.rules
    x, y, depth = hull.camera
    inverse = depth.maximum(rules.nearest_m).reciprocal()
    u = view.focal[0] * x * inverse + view.center[0]
    v = view.focal[1] * y * inverse + view.center[1]
    facing = dot(hull.normal, hull.from_eye)
    width, height = view.width.cast(np.float32), view.height.cast(np.float32)
    margin = float(rules.largest_footprint_px)
    seen = hull.sound & (depth > rules.nearest_m) & (facing < depth * rules.behind)
    seen = seen & (u > -margin) & (v > -margin)
    seen = graph.nonzero(seen & (u < width + margin) & (v < height + margin))
    key = depth_code(scene, depth) * (1 << SURFEL_BITS) + hull.surfel
    u, v, depth, key, facing = (value.take(seen) for value in (u, v, depth, key, facing))
    side = footprint(scene, depth)
    deep_enough = graph.where(facing < depth * -rules.facing, depth, 0.0)
    copies = graph.shape(side * side, 1)
    return Splats(
        pixel=_covered_pixels(scene, u, v, side),
        key=_repeated(scene, key, copies),
        depth=_repeated(scene, deep_enough, copies),
    )


def depth_code(scene: Scene, depth: Value) -> Value:
    """Depth as an integer of 14 bits, in a window about the pelvis."""
    tables, root = scene.tables, scene.view.bones.row(0)
    pelvis = root.row(11)
    for axis in range(3):
        pelvis = pelvis + root.row(8 + axis) * float(tables.pelvis[axis])
    near = pelvis - tables.reach_m
    steps = (depth - near) * ((DEPTH_STEPS - 1) / (2.0 * tables.reach_m))
    return steps.clipped(0.0, DEPTH_STEPS - 1.0).cast(np.int32)


def footprint(scene: Scene, depth: Value) -> Value:
    """Pixels along the edge of every surfel's footprint, an int64 scalar of at least 2.

    It follows the spacing of the surfels where they are nearest to the camera, so that one does
    not see through the hull in a close-up.
    """
    graph, rules, focal = scene.graph, scene.rules, scene.view.focal
    far = graph.constant(np.array([1e6], dtype=np.float32))  # so that there always is a smallest
    nearest = graph.concatenated([depth, far]).smallest()
    spacing_px = focal[0].maximum(focal[1]) * scene.tables.surfels.spacing_m / nearest
    side = (spacing_px * rules.footprint_spacings + 0.999).floor()
    return side.clipped(2.0, float(rules.largest_footprint_px)).cast(np.int64)


def _covered_pixels(scene: Scene, u: Value, v: Value, side: Value) -> Value:
    """The pixels about (u, v), one place of the footprint after the other; `pixels` = outside."""
    graph, view = scene.graph, scene.view
    zero, one = graph.constant(np.int64(0)), graph.constant(np.int64(1))
    corner = (side.cast(np.float32) - 1.0) * 0.5
    offset = graph.node("Range", zero, side * side, one).reshaped(-1, 1)
    down = offset // side
    right = offset - down * side
    x = (u - corner).floor().reshaped(1, -1) + right.cast(np.float32)
    y = (v - corner).floor().reshaped(1, -1) + down.cast(np.float32)
    width, height = view.width.cast(np.float32), view.height.cast(np.float32)
    inside = (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
    pixel = y.cast(np.int32) * view.width.cast(np.int32) + x.cast(np.int32)
    return graph.where(inside, pixel, view.pixels.cast(np.int32)).reshaped(-1)


def _repeated(scene: Scene, value: Value, copies: Value) -> Value:
    return scene.graph.node("Expand", value.reshaped(1, -1), copies).reshaped(-1)


def nearest_keys(scene: Scene, splats: Splats) -> Value:
    """The z-buffer: the least key of every pixel, in one scatter."""
    return _z_buffer(scene, splats.pixel, splats.key)


def keys_behind(scene: Scene, splats: Splats, limit: Value) -> Value:
    """The z-buffer of what lies deeper than `limit` (metres a pixel) and faces the camera."""
    graph = scene.graph
    nothing = graph.constant(np.array([1e6], dtype=np.float32))
    behind = splats.depth > graph.concatenated([limit, nothing]).take(splats.pixel)
    chosen = graph.nonzero(behind)
    return _z_buffer(scene, splats.pixel.take(chosen), splats.key.take(chosen))


def _z_buffer(scene: Scene, pixel: Value, key: Value) -> Value:
    graph, pixels = scene.graph, scene.view.pixels
    empty = graph.filled(graph.shape(pixels + 1), FAR)  # one more, for what lands outside
    return empty.scattered(pixel, key, reduction="min").slices([0], [pixels])


def holes_filled(scene: Scene, keys: Value) -> Value:
    """Fills single pixels that two opposite neighbours overtop."""
    graph, view = scene.graph, scene.view
    image = keys.reshaped(view.height, view.width)
    border = graph.constant(np.array([1, 1, 1, 1], dtype=np.int64))
    padded = graph.node("Pad", image, border, graph.constant(FAR))

    def shifted(down: int, right: int) -> Value:
        return padded.slices([down, right], [view.height + down, view.width + right])

    across = shifted(1, 0).maximum(shifted(1, 2))
    along = shifted(0, 1).maximum(shifted(2, 1))
    neighbours = across.minimum(along)
    steps = int(scene.rules.hole_m / (2.0 * scene.tables.reach_m) * DEPTH_STEPS)
    hole = (image - (steps << SURFEL_BITS)) > neighbours
    return graph.where(hole, neighbours, image).reshaped(-1)

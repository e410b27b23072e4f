"""Nodes that say where each pixel's ray enters the hull, and what it sees from there on."""

from dataclasses import dataclass

import numpy as np

from export.columns import Vector, adjugate, dot, taken
from export.march import Segment, march, sampled, unsquashed
from export.nodes import Value
from export.posing import Place, Posed, carried, inverse_of
from export.raster import Window
from export.scene import Scene, View
from export.surfels import Surfels
from export.tables import SURFEL_BITS


@dataclass(frozen=True, eq=False, kw_only=True)
class Layer:
    """One depth layer: values of the graph, one entry a ray.

    Attributes:
        ray: Directions in the camera's frame, of length 1.
        surfel: What each ray sees, and
        canonical, camera: where that is.
        color: Premultiplied.
        light: What is let through, in [0, 1].
        enter, end: Where the ray enters the hull and where it ends, metres along it.
    """

    ray: Vector
    surfel: Value
    canonical: Vector
    camera: Vector
    color: Vector
    light: Value
    enter: Value
    end: Value


@dataclass(frozen=True, eq=False, kw_only=True)
class Hull:
    """What rays meet: the surfels, and the skin's nodes in the camera's frame."""

    surfels: Surfels
    posed: Posed


def rays(view: View, window: Window, pixel: Value) -> Vector:
    """Unit directions in the camera's frame through the centres of the window's pixels (int32)."""
    width = window.width.cast(np.int32)
    row = pixel // width
    column = pixel - row * width
    x = column.cast(np.float32) + (window.left.cast(np.float32) + 0.5 - view.center[0])
    y = row.cast(np.float32) + (window.top.cast(np.float32) + 0.5 - view.center[1])
    x, y = x / view.focal[0], y / view.focal[1]
    scale = (x * x + y * y + 1.0).sqrt().reciprocal()
    return [x * scale, y * scale, scale]


def shade(scene: Scene, hull: Hull, keys: Value, ray: Vector, before: Layer | None) -> Layer:
    """Colour and light behind of rays.

    The map from canonical space to the camera's is taken as linear about the surfel that a ray
    sees: its inverse carries the ray to where it enters the hull.

    Args:
        scene: What is drawn.
        hull: In its pose.
        keys: What each ray sees.
        ray: Directions.
        before: What the same rays saw in the first layer, if this is the second.
    """
    graph, surfel = scene.graph, keys.masked((1 << SURFEL_BITS) - 1)
    place = hull.surfels.place
    place = Place(rows=taken(place.rows, surfel), fraction=taken(place.fraction, surfel))
    camera, derivative = carried(scene, hull.posed, place)
    inverse = inverse_of(scene, derivative, adjugate(derivative))
    normal = taken([scene.columns[f"normal_{letter}"] for letter in "xyz"], surfel)
    # where the skin is folded, the hull is looked at from straight above
    above = [-n for n in normal]
    seen_along = zip(inverse.applied(ray), above, strict=True)
    direction = [graph.where(inverse.trusted, d, a) for d, a in seen_along]
    along = dot(camera, ray)
    beside = inverse.applied([along * r - c for r, c in zip(ray, camera, strict=True)])
    thickness = scene.columns["thickness"].take(surfel)
    enter, begin, end = _extent(scene, normal, thickness, direction, beside, along)
    canonical = taken([scene.columns[f"position_{letter}"] for letter in "xyz"], surfel)
    if before is not None:
        begin = _after(scene, before, canonical, camera, begin, end)
    way = begin - along
    start = [p + b + way * d for p, b, d in zip(canonical, beside, direction, strict=True)]
    segment = Segment(ray=ray, begin=begin, end=end, canonical=start, direction=direction)
    if before is None:
        color, light = march(scene, hull.posed, segment)
    else:
        rules = scene.rules
        block = sampled(scene, segment, begin * 0.0 + 1.0, rules.second_block, rules.longest_m)
        color, light = block.color, block.light
    return Layer(
        ray=ray,
        surfel=surfel,
        canonical=canonical,
        camera=camera,
        color=color,
        light=light,
        enter=enter,
        end=end,
    )


def _extent(
    scene: Scene,
    normal: Vector,
    thickness: Value,
    direction: Vector,
    beside: Vector,
    along: Value,
) -> tuple[Value, Value, Value]:
    """Where rays enter the hull's tangent plane, and from where to where they are followed.

    `beside` is where each ray comes closest to its surfel, seen from that in canonical space,
    `along` how far that is along the ray.
    """
    graph, rules = scene.graph, scene.rules
    falling = dot(normal, direction)
    shallow = -0.5 * rules.steepest
    hit = -dot(normal, beside) / falling.minimum(shallow)
    hit = graph.where(falling < shallow, hit, 0.0).clipped(-rules.slack_m, rules.slack_m)
    enter = along + hit
    cosine = (-falling).maximum(rules.steepest)
    lead = (rules.lead_m / cosine).minimum(unsquashed(scene, direction) * rules.most_lead_m)
    sine = 1.0 - falling * falling / dot(direction, direction).maximum(1e-12)
    bent = cosine.minimum(rules.squash_limit)  # compression at the surfel seldom lasts
    times = ((sine * rules.grazing + 1.0) / bent).minimum(rules.lengthened)
    length = (thickness * times + lead).minimum(rules.longest_m)
    begin = enter - lead
    return enter, begin, begin + length


def _after(
    scene: Scene, before: Layer, canonical: Vector, camera: Vector, begin: Value, end: Value
) -> Value:
    """Where rays begin that must not see a second time what they have passed already."""
    rules = scene.rules

    def apart(here: Vector, first: Vector) -> Value:
        between = [a - b for a, b in zip(here, first, strict=True)]
        return dot(between, between).sqrt()

    one_sheet = (
        apart(canonical, before.canonical)
        < apart(camera, before.camera) * rules.same_share + rules.same_m
    )
    later = begin.maximum(before.end).minimum(end)
    return scene.graph.where(one_sheet, later, begin)

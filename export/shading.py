"""Nodes that say where each pixel's ray enters the hull, and what it sees from there on."""

from dataclasses import dataclass

import numpy as np

from export.columns import Vector, dot, taken
from export.march import Segment, march
from export.nodes import Value
from export.raster import FAR, Hull
from export.scene import Scene, View
from export.tables import SURFEL_BITS


@dataclass(frozen=True, eq=False, kw_only=True)
class Layer:
    """One depth layer: values of the graph, one entry a covered pixel.

    Attributes:
        pixel: Which pixel.
        surfel: Which surfel it sees.
        color: Premultiplied.
        alpha: In [0, 1].
        depth: Where the ray enters the hull, metres along z.
        end: Where it ends, metres along the ray.
    """

    pixel: Value
    surfel: Value
    color: Vector
    alpha: Value
    depth: Value
    end: Value


@dataclass(frozen=True, eq=False, kw_only=True)
class Before:
    """What a second layer has before it: values of the graph, one entry a pixel of the picture."""

    key: Value
    end: Value


def shade(scene: Scene, hull: Hull, keys: Value, wanted: Value, before: Before | None) -> Layer:
    """Colour and alpha of every pixel that is `wanted` and covered.

    The map from canonical space to the camera's is taken as linear about the surfel that the
    pixel sees: its inverse carries the ray to where it enters the hull.
    """
    pixel = scene.graph.nonzero((keys < FAR) & wanted)
    surfel = _surfel(keys.take(pixel))
    inverse = [taken(row, surfel) for row in hull.inverse]
    ray = _rays(scene.view, pixel)
    direction = [dot(row, ray) for row in inverse]
    from_eye = taken(hull.from_eye, surfel)
    camera = taken(hull.camera, surfel)
    enter, begin, end = _extent(scene, hull, surfel, direction, from_eye, dot(camera, ray))
    if before is not None:
        begin = _after(scene, hull, surfel, before, pixel, begin, end)
    canonical = [
        a - b + begin * c
        for a, b, c in zip(taken(hull.canonical, surfel), from_eye, direction, strict=True)
    ]
    segment = Segment(ray=ray, begin=begin, end=end, canonical=canonical, direction=direction)
    steady = scene.rules.steady if before is None else 1
    color, alpha = march(scene, hull.posed, segment, steady=steady)
    return Layer(
        pixel=pixel, surfel=surfel, color=color, alpha=alpha, depth=enter * ray[2], end=end
    )


def _surfel(keys: Value) -> Value:
    return keys.masked((1 << SURFEL_BITS) - 1)


def _rays(view: View, pixel: Value) -> Vector:
    """Unit directions through the pixels' centres in the camera's frame."""
    number = pixel.cast(np.int32)
    width = view.width.cast(np.int32)
    row = number // width
    column = number - row * width
    x = (column.cast(np.float32) + 0.5 - view.center[0]) / view.focal[0]
    y = (row.cast(np.float32) + 0.5 - view.center[1]) / view.focal[1]
    scale = (x * x + y * y + 1.0).sqrt().reciprocal()
    return [x * scale, y * scale, scale]


def _extent(
    scene: Scene, hull: Hull, surfel: Value, direction: Vector, from_eye: Vector, along: Value
) -> tuple[Value, Value, Value]:
    """Where rays enter the hull's tangent plane, and from where to where they are followed."""
    graph, rules = scene.graph, scene.rules
    normal = taken(hull.normal, surfel)
    thickness = scene.columns["thickness"].take(surfel)
    falling = dot(normal, direction)
    shallow = -0.5 * rules.steepest
    hit = dot(normal, from_eye) / falling.minimum(shallow)
    enter = graph.where(falling < shallow, hit, along)
    enter = enter.minimum(along + rules.slack_m).maximum(along - rules.slack_m)
    cosine = (-falling).maximum(rules.steepest)
    lead = (rules.lead_m / cosine).minimum(rules.most_lead_m)
    sine = 1.0 - falling * falling / dot(direction, direction)
    length = (thickness * (sine * rules.grazing + 1.0) / cosine + lead).minimum(rules.longest_m)
    begin = enter - lead
    return enter, begin, begin + length


def _after(
    scene: Scene, hull: Hull, surfel: Value, before: Before, pixel: Value, begin: Value, end: Value
) -> Value:
    """Where rays begin that must not see a second time what they have passed already."""
    first, rules = _surfel(before.key.take(pixel)), scene.rules

    def apart(vector: Vector) -> Value:
        between = [v.take(surfel) - v.take(first) for v in vector]
        return dot(between, between).sqrt()

    one_sheet = apart(hull.canonical) < apart(hull.camera) * rules.same_share + rules.same_m
    later = begin.maximum(before.end.take(pixel)).minimum(end)
    return scene.graph.where(one_sheet, later, begin)

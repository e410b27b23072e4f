"""The player's graph: bones and camera in, a picture with alpha out. The only door out of numpy."""

from dataclasses import replace

import numpy as np
import onnx

from export.columns import taken
from export.initialisers import initialisers
from export.nodes import Graph, Value
from export.posing import pose_nodes
from export.raster import (
    FAR,
    Splats,
    Window,
    hidden_by,
    keys_behind,
    limits_at,
    nearest_keys,
    splat,
)
from export.rules import DrawingRules
from export.scene import Scene, View
from export.shading import Hull, Layer, rays, shade
from export.surfels import pose_surfels
from export.tables import Tables


def build_graph(tables: Tables, rules: DrawingRules) -> onnx.ModelProto:
    """The graph that draws `tables`.

    Inputs: `bones` (24, 12), camera-from-canonical 3×4 matrices in metres; `camera` (4), focal
    lengths and centre in pixels; `height`, `width`, `samples`, int64 scalars. Output: `rgba`
    (height × width), int32: red, green, blue and straight alpha, one byte each, red the lowest.
    Its tables stay outside (`initialisers`).
    """
    graph = Graph()
    scene = Scene(
        graph=graph,
        tables=tables,
        columns={
            name: graph.table(name, array) for name, array in initialisers(tables, rules).items()
        },
        rules=rules,
        view=_view(graph),
        samples=graph.input("samples", np.int64, []),
    )
    graph.output(_picture(scene), "rgba", ["pixels"])
    return graph.model()


def _picture(scene: Scene) -> Value:
    graph = scene.graph
    posed = pose_nodes(scene)
    hull = Hull(surfels=pose_surfels(scene, posed), posed=posed)
    splats = splat(scene, hull.surfels)
    window = splats.window
    keys = nearest_keys(scene, splats)
    covered = keys < FAR
    pixel = graph.range((window.width * window.height).cast(np.int32)).compressed(covered)
    ray = rays(scene.view, window, pixel)
    first = shade(scene, hull, keys.take(pixel), ray, None)
    channels = [*first.color, first.light]
    if scene.rules.layers > 1:
        channels = _with_further(scene, hull, splats, pixel, first)
    return _drawn(scene, window, pixel, channels)


def _view(graph: Graph) -> View:
    bones = graph.input("bones", np.float32, [24, 12])
    camera = graph.input("camera", np.float32, [4])
    return View(
        bones=bones,
        focal=(camera.row(0), camera.row(1)),
        center=(camera.row(2), camera.row(3)),
        height=graph.input("height", np.int64, []),
        width=graph.input("width", np.int64, []),
    )


def _with_further(
    scene: Scene, hull: Hull, splats: Splats, pixel: Value, first: Layer
) -> list[Value]:
    """Colour and light after all layers, one entry a ray of the first."""
    graph, window, hidden = scene.graph, splats.window, None
    color, light, before = first.color, first.light, first
    number = graph.range(graph.size(pixel).cast(np.int32))
    for _ in range(1, scene.rules.layers):
        wanted = before.light > scene.rules.transmitted
        kept = graph.range(graph.size(number).cast(np.int32)).compressed(wanted)
        cell = _cells(window, pixel.take(number.take(kept)))
        depth = (before.enter * before.ray[2]).take(kept) + scene.rules.gap_m
        limits = limits_at(scene, window, cell, depth)
        hidden = hidden or hidden_by(scene, hull.posed, hull.surfels, splats, limits)
        keys = keys_behind(scene, hull.surfels, hidden, limits, cell, before.surfel.take(kept))
        there = keys < FAR
        keys, kept = keys.compressed(there), kept.compressed(there)
        number = number.take(kept)
        seen_from = Layer(
            ray=taken(before.ray, kept),
            surfel=before.surfel.take(kept),
            canonical=taken(before.canonical, kept),
            camera=taken(before.camera, kept),
            color=before.color,
            light=before.light.take(kept),
            enter=before.enter,
            end=before.end.take(kept),
        )
        layer = shade(scene, hull, keys, seen_from.ray, seen_from)
        color = [
            c.scattered(number, behind * seen_from.light, reduction="add")
            for c, behind in zip(color, layer.color, strict=True)
        ]
        before = replace(layer, light=seen_from.light * layer.light)
        light = light.scattered(number, before.light)
    return [*color, light]


def _cells(window: Window, pixel: Value) -> Value:
    """Cells of the buffer in which pixels of the window lie."""
    width, stride = window.width.cast(np.int32), window.stride.cast(np.int32)
    row = pixel // width
    border = window.border.cast(np.int32)
    return (row + border) * stride + (pixel - row * width + border)


def _drawn(scene: Scene, window: Window, pixel: Value, channels: list[Value]) -> Value:
    """The whole picture, eight bits a channel, straight alpha: colour is divided by alpha."""
    graph, view = scene.graph, scene.view
    *color, light = channels
    alpha = 1.0 - light
    inverse = 255.0 / alpha.maximum(1e-6)
    bytes_ = [
        (value + 0.5).clipped(0.0, 255.0).cast(np.int32)
        for value in [*(channel * inverse for channel in color), alpha * 255.0]
    ]
    red, green, blue, alpha = bytes_
    alpha = graph.where(alpha > 127, alpha - 256, alpha)  # the highest byte holds the sign
    packed = red + green * (1 << 8) + blue * (1 << 16) + alpha * (1 << 24)
    width = window.width.cast(np.int32)
    row = pixel // width
    column = pixel - row * width + window.left.cast(np.int32)
    place = (row + window.top.cast(np.int32)) * view.width.cast(np.int32) + column
    empty = graph.filled(graph.shape(view.pixels), np.int32(0))
    return empty.scattered(place, packed)

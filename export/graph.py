"""The player's graph: bones and camera in, a picture with alpha out. The only door out of numpy."""

import numpy as np
import onnx

from export.nodes import Graph, Value
from export.raster import View, holes_filled, keys_behind, nearest_keys, pose_hull, splat
from export.rules import DrawingRules
from export.shading import Layer, shade
from export.tables import Tables, initialisers


def build_graph(tables: Tables, rules: DrawingRules) -> onnx.ModelProto:
    """The graph that draws `tables`.

    Inputs: `bones` (24, 12), camera-from-canonical 3×4 matrices in metres; `camera` (4), focal
    lengths and centre in pixels; `height`, `width`, `samples`, int64 scalars. Output: `rgba`
    (height, width, 4), uint8, straight alpha. Its tables stay outside (`initialisers`).
    """
    graph = Graph()
    view = _view(graph)
    samples = graph.input("samples", np.int64, [])
    columns = {name: graph.table(name, array) for name, array in initialisers(tables).items()}
    hull = pose_hull(graph, columns, view)
    splats = splat(graph, hull, view, tables, rules)

    def layer(keys: Value, wanted: Value) -> Layer:
        return shade(graph, columns, tables, hull, view, keys, wanted, samples, rules)

    keys = holes_filled(graph, nearest_keys(graph, splats, view), view, tables, rules)
    everywhere = graph.filled(graph.shape(view.pixels), np.True_)
    first = layer(keys, everywhere)
    empty = graph.filled(graph.shape(view.pixels), np.float32(0))
    picture = [empty.scattered(first.pixel, channel) for channel in [*first.color, first.alpha]]
    if rules.layers == 2:
        passed = 1.0 - picture[3]
        nearest = graph.filled(graph.shape(view.pixels), np.float32(1e6))
        limit = nearest.scattered(first.pixel, first.depth + rules.gap_m)
        wanted = passed > rules.transmitted
        limit = graph.where(wanted, limit, 1e6)
        second = layer(keys_behind(graph, splats, limit, view), wanted)
        picture = _with_layer_behind(picture, second, passed)
    graph.output(_as_bytes(graph, picture, view), "rgba", ["height", "width", 4])
    return graph.model()


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


def _with_layer_behind(picture: list[Value], second: Layer, passed: Value) -> list[Value]:
    """Adds what the first layer lets through."""
    seen = passed.take(second.pixel)
    return [
        channel.scattered(second.pixel, behind * seen, reduction="add")
        for channel, behind in zip(picture, [*second.color, second.alpha], strict=True)
    ]


def _as_bytes(graph: Graph, picture: list[Value], view: View) -> Value:
    """Eight bits a channel, straight alpha: colour is divided by alpha."""
    *color, alpha = picture
    inverse = alpha.maximum(1e-6).reciprocal()
    channels = [*(channel * inverse for channel in color), alpha]
    planes = [channel.reshaped(1, view.height, view.width) for channel in channels]
    image = graph.concatenated(planes).transposed(1, 2, 0)
    return (image * 255.0 + 0.5).clipped(0.0, 255.0).cast(np.uint8)

"""The player's graph: bones and camera in, a picture with alpha out. The only door out of numpy."""

import numpy as np
import onnx

from export.initialisers import initialisers
from export.nodes import Graph, Value
from export.raster import holes_filled, keys_behind, nearest_keys, pose_hull, splat
from export.rules import DrawingRules
from export.scene import Scene, View
from export.shading import Before, Layer, shade
from export.tables import Tables


def build_graph(tables: Tables, rules: DrawingRules) -> onnx.ModelProto:
    """The graph that draws `tables`.

    Inputs: `bones` (24, 12), camera-from-canonical 3×4 matrices in metres; `camera` (4), focal
    lengths and centre in pixels; `height`, `width`, `samples`, int64 scalars. Output: `rgba`
    (height, width, 4), uint8, straight alpha. Its tables stay outside (`initialisers`).
    """
    graph = Graph()
    scene = Scene(
        graph=graph,
        tables=tables,
        columns={name: graph.table(name, array) for name, array in initialisers(tables).items()},
        rules=rules,
        view=_view(graph),
        samples=graph.input("samples", np.int64, []),
    )
    picture = _picture(scene)
    graph.output(_as_bytes(scene, picture), "rgba", ["height", "width", 4])
    return graph.model()


def _picture(scene: Scene) -> list[Value]:
    """Premultiplied colour and alpha, a value per channel with one entry a pixel."""
    graph, rules = scene.graph, scene.rules
    pixels = graph.shape(scene.view.pixels)
    hull = pose_hull(scene)
    splats = splat(scene, hull)
    keys = holes_filled(scene, nearest_keys(scene, splats))
    first = shade(scene, hull, keys, graph.filled(pixels, np.True_), None)
    empty = graph.filled(pixels, np.float32(0))
    picture = [empty.scattered(first.pixel, channel) for channel in [*first.color, first.alpha]]
    if rules.layers == 1:
        return picture
    passed = 1.0 - picture[3]
    wanted = passed > rules.transmitted
    limit = graph.filled(pixels, np.float32(1e6))
    limit = limit.scattered(first.pixel, first.depth + rules.gap_m)
    limit = graph.where(wanted, limit, 1e6)
    before = Before(key=keys, end=empty.scattered(first.pixel, first.end))
    second = shade(scene, hull, keys_behind(scene, splats, limit), wanted, before)
    return _with_layer_behind(picture, second, passed)


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


def _as_bytes(scene: Scene, picture: list[Value]) -> Value:
    """Eight bits a channel, straight alpha: colour is divided by alpha."""
    view = scene.view
    *color, alpha = picture
    inverse = alpha.maximum(1e-6).reciprocal()
    channels = [*(channel * inverse for channel in color), alpha]
    planes = [channel.reshaped(1, view.height, view.width) for channel in channels]
    image = scene.graph.concatenated(planes).transposed(1, 2, 0)
    return (image * 255.0 + 0.5).clipped(0.0, 255.0).cast(np.uint8)

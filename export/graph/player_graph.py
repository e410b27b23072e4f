"""The player's ONNX graph: bones and camera in, a picture with alpha out."""

from dataclasses import replace

import numpy as np
import onnx

from export.graph.graph_ray_setup import (
    DepthLayer,
    PosedProxySurface,
    filter_specks,
    pixel_rays,
    trace_depth_layer,
)
from export.graph.graph_skinning import CameraValues, GraphContext, pose_nodes, pose_surfels
from export.graph.graph_zbuffer import (
    EMPTY_KEY,
    SplatWindow,
    SurfelSplats,
    depth_limits,
    hidden_splats,
    keys_behind_limits,
    nearest_keys,
    project_surfels,
)
from export.graph.onnx_builder import GraphBuilder, GraphValue
from export.package.player_tables import MIN_FOOTPRINT_PX, PlayerTables, RenderSettings
from export.player_inputs import graph_initializers

TRACE_OUTPUTS = ["pixel", "doubtful", "passed", "footprint_px", "ray", "layer", "path"]
"""Outputs of `build_trace_graph`: covered pixels of the picture in ascending order; whether each is
doubtful, and whether light passes its first layer; the edge of a footprint; and of each block of
samples the ray, counted as pixels are, the layer from 0, and the path (`BlockValues`)."""


def build_trace_graph(tables: PlayerTables, settings: RenderSettings) -> onnx.ModelProto:
    """Build the graph that tells where the player's rays sample `tables`, each to its end.

    Inputs and tables as of `build_graph`; outputs `TRACE_OUTPUTS`.
    """
    return _build(tables, replace(settings, min_transmittance=-1.0), traces=True)


def build_graph(tables: PlayerTables, settings: RenderSettings) -> onnx.ModelProto:
    """Build the graph that draws `tables`.

    Inputs: `bones` (24, 12), camera-from-canonical 3×4 matrices in metres; `camera` (4), focal
    lengths and center in pixels; `height`, `width`, `samples`, int64 scalars. Output: `rgba`
    (height × width), int32: red, green, blue and straight alpha, one byte each, red the lowest.
    Its tables are external, named as in `graph_initializers`.
    """
    return _build(tables, settings, traces=False)


def _build(tables: PlayerTables, settings: RenderSettings, *, traces: bool) -> onnx.ModelProto:
    graph = GraphBuilder()
    context = GraphContext(
        graph=graph,
        tables=tables,
        table_values={
            name: graph.table(name, array)
            for name, array in graph_initializers(tables, settings).items()
        },
        settings=settings,
        camera=_camera_inputs(graph),
        samples=graph.input("samples", np.int64, []),
        traces=traces,
    )
    _draw_picture(context)
    return graph.model()


def _draw_picture(context: GraphContext) -> None:
    """Splat and trace all layers; filter specks and pack, or tell where the rays were."""
    graph = context.graph
    posed = pose_nodes(context)
    surfels = pose_surfels(context, posed)
    splats = project_surfels(context, surfels)
    close_up = splats.footprint_px > MIN_FOOTPRINT_PX - 1
    surface = PosedProxySurface(surfels=surfels, posed=posed, close_up=close_up)
    window = splats.window
    keys = nearest_keys(context, splats)
    covered = keys < EMPTY_KEY
    pixel = graph.range((window.width * window.height).cast(np.int32)).compress(covered)
    ray = pixel_rays(context.camera, window, pixel)
    first = trace_depth_layer(context, surface, keys.gather(pixel), ray, None)
    color, light, blocks = _add_further_layers(context, surface, splats, pixel, first)
    if context.traces:
        passed = first.transmittance > context.settings.layer_min_transmittance
        covered = _picture_pixels(context, window, pixel)
        parts = [covered, first.doubtful, passed, splats.footprint_px, *blocks]
        for value, name in zip(parts, TRACE_OUTPUTS, strict=True):
            graph.output(value, name, {"footprint_px": [], "path": [7, "blocks"]}.get(name, ["_"]))
        return
    channels = graph.concatenate([color, (1.0 - light).reshape(1, -1)])
    channels = filter_specks(context, splats, _window_cells(window, pixel), first, channels)
    graph.output(_pack_rgba(context, window, pixel, channels), "rgba", ["pixels"])


def _camera_inputs(graph: GraphBuilder) -> CameraValues:
    bones = graph.input("bones", np.float32, [24, 12])
    camera = graph.input("camera", np.float32, [4])
    return CameraValues(
        bones=bones,
        focal=(camera.row(0), camera.row(1)),
        center=(camera.row(2), camera.row(3)),
        height=graph.input("height", np.int64, []),
        width=graph.input("width", np.int64, []),
    )


def _add_further_layers(
    context: GraphContext,
    surface: PosedProxySurface,
    splats: SurfelSplats,
    pixel: GraphValue,
    first: DepthLayer,
) -> tuple[GraphValue, GraphValue, list[GraphValue]]:
    """Return color and transmittance after all layers, one column a ray of the first.

    With `context.traces` also the ray, the layer and the path of all blocks of samples.
    """
    graph, window, hidden = context.graph, splats.window, None
    color, light, before = first.color, first.transmittance, first
    number = graph.range(graph.size(pixel).cast(np.int32))
    traced = [first.blocks]
    for _ in range(1, context.settings.layers):
        wanted = before.transmittance > context.settings.layer_min_transmittance
        kept = graph.range(graph.size(number).cast(np.int32)).compress(wanted)
        cell = _window_cells(window, pixel.gather(number.gather(kept)))
        depth = (before.enter * before.ray.row(2)).gather(kept) + context.settings.layer_gap_m
        limits = depth_limits(context, window, cell, depth)
        hidden = hidden or hidden_splats(context, surface.posed, surface.surfels, splats, limits)
        keys = keys_behind_limits(
            context, surface.surfels, hidden, limits, cell, before.surfel.gather(kept)
        )
        there = keys < EMPTY_KEY
        keys, kept = keys.compress(there), kept.compress(there)
        number = number.gather(kept)
        vectors = kept.repeat_rows(3)
        seen_from = replace(
            before,
            ray=before.ray.gather_columns(vectors),
            surfel=before.surfel.gather(kept),
            canonical_position=before.canonical_position.gather_columns(vectors),
            camera_position=before.camera_position.gather_columns(vectors),
            transmittance=before.transmittance.gather(kept),
            end=before.end.gather(kept),
        )
        layer = trace_depth_layer(context, surface, keys, seen_from.ray, seen_from)
        added = layer.color * seen_from.transmittance
        color = color.scatter(number.repeat_rows(3), added, reduction="add", axis=1)
        before = replace(layer, transmittance=seen_from.transmittance * layer.transmittance)
        light = light.scatter(number, before.transmittance)
        traced.append([number.gather(layer.blocks[0]), layer.blocks[1]] if layer.blocks else [])
    if not context.traces:
        return color, light, []
    layers = [rays * 0 + layer for layer, (rays, _) in enumerate(traced)]
    rays, paths = zip(*traced, strict=True)
    blocks = [graph.concatenate(rays), graph.concatenate(layers)]
    return color, light, [*blocks, graph.concatenate(paths, axis=1)]


def _window_cells(window: SplatWindow, pixel: GraphValue) -> GraphValue:
    """Return the buffer's cells of pixels of the window."""
    width, stride = window.width.cast(np.int32), window.stride.cast(np.int32)
    row = pixel // width
    border = window.border.cast(np.int32)
    return (row + border) * stride + (pixel - row * width + border)


def _pack_rgba(
    context: GraphContext, window: SplatWindow, pixel: GraphValue, channels: GraphValue
) -> GraphValue:
    """Pack the whole picture into one int32 a pixel, straight alpha: divide color by alpha."""
    graph, view = context.graph, context.camera
    alpha = channels.row(3)
    scaled = channels * (255.0 / alpha.maximum(1e-6))
    red, green, blue, alpha = (
        (value + 0.5).clip(0.0, 255.0).cast(np.int32)
        for value in [*(scaled.row(channel) for channel in range(3)), alpha * 255.0]
    )
    alpha = graph.where(alpha > 127, alpha - 256, alpha)  # the highest byte has the sign bit
    packed = red + green * (1 << 8) + blue * (1 << 16) + alpha * (1 << 24)
    empty = graph.full(graph.shape(view.height * view.width), np.int32(0))
    return empty.scatter(_picture_pixels(context, window, pixel), packed)


def _picture_pixels(context: GraphContext, window: SplatWindow, pixel: GraphValue) -> GraphValue:
    """Return the picture's numbers of pixels of the window."""
    width = window.width.cast(np.int32)
    row = pixel // width
    column = pixel - row * width + window.left.cast(np.int32)
    return (row + window.top.cast(np.int32)) * context.camera.width.cast(np.int32) + column

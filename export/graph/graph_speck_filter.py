"""Nodes that filter specks: the median about pixels in which folded or crossing skin is seen."""

import numpy as np

from export.graph.graph_context import GraphContext
from export.graph.graph_ray_setup import DepthLayer
from export.graph.graph_zbuffer import SurfelSplats
from export.graph.onnx_builder import GraphValue
from export.package.render_settings import (
    MAX_MEDIAN_DIFFERENCE,
    MIN_FOOTPRINT_PX,
    MIN_MEDIAN_ALPHA,
)

TAPS = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
"""Rows and columns, in halves of a footprint, of the pixels whose median is taken."""


def filter_specks(
    context: GraphContext,
    splats: SurfelSplats,
    cell: GraphValue,
    first: DepthLayer,
    channels: list[GraphValue],
) -> list[GraphValue]:
    """Replace doubtful pixels, and specks behind the first layer, by the median about them.

    A pixel is doubtful where the pose folds the skin about its surfel, compresses it along the ray,
    or shows it from behind (`DepthLayer`): there a ray sees the surfel's own color or a wrong place
    of the cloth. A speck is a pixel whose ray passed the first layer, which should have stopped it:
    it lies inside of the avatar and differs from what is about it. Both are smaller than a
    footprint. The reference is `export.reference.reference_player.filter_specks`.

    Args:
        context: Settings.
        splats: All surfels.
        cell: The z-buffer's cell of each covered pixel.
        first: First layer, of the same pixels.
        channels: Premultiplied color and transmittance.
    """
    graph, window = context.graph, splats.window
    passed = first.transmittance > context.settings.layer_min_transmittance
    covered = graph.range(graph.size(cell).cast(np.int32))
    suspect = covered.compress(first.doubtful | passed)
    half, rows_columns = splats.footprint_px // 2, np.array(TAPS, dtype=np.int64)
    rows, columns = (graph.constant(part) for part in rows_columns.T)
    steps = ((rows * window.stride + columns) * half).cast(np.int32)
    empty = graph.size(cell).cast(np.int32)
    numbers = (graph.full(graph.shape(window.cells), np.int32(0)) + empty).scatter(cell, covered)
    around = cell.gather(suspect).reshape(1, -1) + steps.reshape(-1, 1)
    around = numbers.gather(around.reshape(-1))
    nothing = graph.constant(np.zeros(1, dtype=np.float32))
    *color, light = channels
    values = [*color, 1.0 - light]
    taps = [
        graph.concatenate([value, nothing]).gather(around).reshape(len(TAPS), -1)
        for value in values
    ]
    nine = graph.split(graph.concatenate(taps, axis=1), len(TAPS))
    median = _median_of_nine(nine)
    apart = median - nine[len(TAPS) // 2]
    medians, apart = (
        [part.reshape(-1) for part in graph.split(value.reshape(len(values), -1), len(values))]
        for value in (median, apart.maximum(-apart))
    )
    differs = apart[0].maximum(*apart[1:]) > MAX_MEDIAN_DIFFERENCE
    fine = splats.footprint_px > MIN_FOOTPRINT_PX - 1
    speck = (medians[-1] > MIN_MEDIAN_ALPHA) & differs & fine
    chosen = first.doubtful.gather(suspect) | speck
    there = suspect.compress(chosen)
    *color, alpha = (
        value.scatter(there, part.compress(chosen))
        for value, part in zip(values, medians, strict=True)
    )
    return [*color, 1.0 - alpha]


def _median_of_nine(values: list[GraphValue]) -> GraphValue:
    """Return the median, by the least, the middle and the greatest of each three."""
    threes = [values[start : start + 3] for start in (0, 3, 6)]
    least = [a.minimum(b, c) for a, b, c in threes]
    middle = [_median_of_three(*three) for three in threes]
    greatest = [a.maximum(b, c) for a, b, c in threes]
    return _median_of_three(
        least[0].maximum(*least[1:]),
        _median_of_three(*middle),
        greatest[0].minimum(*greatest[1:]),
    )


def _median_of_three(a: GraphValue, b: GraphValue, c: GraphValue) -> GraphValue:
    return a.minimum(b).maximum(a.maximum(b).minimum(c))

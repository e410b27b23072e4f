"""Nodes that read colour and density out of the bricks."""

from collections.abc import Sequence

import numpy as np

from export.columns import Vector
from export.nodes import Graph, Value
from export.tables import BRICK, LOG_DENSITY, NODES, Bricks

STRIDES = (NODES * NODES, NODES, 1)
"""Steps along x, y and z inside a brick."""
FULL = 256
"""Interpolation weights are integers that sum to this: two channels share a multiplication."""


def read_bricks(
    graph: Graph, tables: dict[str, Value], bricks: Bricks, lattice: Vector
) -> tuple[Vector, Value]:
    """Tetrahedral interpolation at lattice coordinates (four corners instead of eight).

    Args:
        graph: The graph.
        tables: The initialisers.
        bricks: Their sizes.
        lattice: (point - low) / voxel_m.

    Returns:
        Colour × 255 × 256, and density in 1/m.
    """
    base, fraction = _cell(graph, tables, bricks, lattice)
    red_blue = green_density = None
    for place, weight in _corners(graph, base, fraction):
        pair = tables["voxel_red_blue"].take(place) * weight
        other = tables["voxel_green_density"].take(place) * weight
        red_blue = pair if red_blue is None else red_blue + pair
        green_density = other if green_density is None else green_density + other
    assert red_blue is not None
    assert green_density is not None
    low, high = LOG_DENSITY
    code = _upper(green_density)
    density = (code * ((high - low) / (255.0 * FULL)) + low).exp()
    density = graph.where(code > FULL / 2.0, density, 0.0)
    return [_lower(red_blue), _lower(green_density), _upper(red_blue)], density


def _cell(
    graph: Graph, tables: dict[str, Value], bricks: Bricks, lattice: Vector
) -> tuple[Value, Vector]:
    """Address of the voxel below a point, and how far the point is beyond it."""
    counts = bricks.index.shape
    inside = [
        coordinate.clipped(0.0, count * BRICK - 1e-3)
        for coordinate, count in zip(lattice, counts, strict=True)
    ]
    voxel = [coordinate.floor() for coordinate in inside]
    brick = [(coordinate * (1.0 / BRICK)).floor() for coordinate in voxel]
    number = (brick[0] * float(counts[1]) + brick[1]) * float(counts[2]) + brick[2]
    local = None
    for axis, stride in enumerate(STRIDES):
        steps = (voxel[axis] - brick[axis] * float(BRICK)) * float(stride)
        local = steps if local is None else local + steps
    assert local is not None
    base = tables["brick_offset"].take(number.cast(np.int32)) + local.cast(np.int32)
    return base, [a - b for a, b in zip(inside, voxel, strict=True)]


def _corners(graph: Graph, base: Value, fraction: Vector) -> Sequence[tuple[Value, Value]]:
    """The corners of the tetrahedron that holds a point, and their integer weights.

    Of a cell's six tetrahedra along its diagonal, the one whose path takes the axis of the
    largest fraction first.
    """
    x, y, z = fraction
    sx, sy, sz = STRIDES
    x_over_y, x_over_z, y_over_z = x > y, x > z, y > z

    def chosen(condition: Value, yes: Value | int, no: Value | int) -> Value:
        sides = [graph.value(side, np.int32) for side in (yes, no)]
        return graph.where(condition, *sides)

    first = chosen(x_over_y, chosen(x_over_z, sx, sz), chosen(y_over_z, sy, sz))
    last_two = chosen(
        x_over_y,
        chosen(y_over_z, sx + sy, sx + sz),
        chosen(x_over_z, sx + sy, sy + sz),
    )
    largest, smallest = x.maximum(y, z), x.minimum(y, z)
    middle = (x + y + z) - largest - smallest
    a, b, c = ((part * float(FULL) + 0.5).cast(np.int32) for part in (largest, middle, smallest))
    return [
        (base, FULL - a),
        (base + first, a - b),
        (base + last_two, b - c),
        (base + (sx + sy + sz), c),
    ]


def _lower(pair: Value) -> Value:
    return pair.masked(0xFFFF).cast(np.float32)


def _upper(pair: Value) -> Value:
    return pair.shifted_right(16).cast(np.float32)

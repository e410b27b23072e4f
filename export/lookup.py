"""Nodes that read colour and density out of the bricks."""

from dataclasses import dataclass

import numpy as np

from export.columns import Vector
from export.nodes import Graph, Value
from export.scene import Scene
from export.tables import BRICK, LOG_DENSITY, NODES, Bricks

STRIDES = (NODES * NODES, NODES, 1)
"""Steps along x, y and z inside a brick."""
FULL = 256
"""Weights of colours are integers that sum to this: two channels share a multiplication."""
LOCAL_BITS = 10
"""A voxel's place inside its brick takes so many bits, the brick's block the others."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Cell:
    """Tetrahedra that hold some points: values of the graph, one entry a point.

    A cell is cut into six tetrahedra along its diagonal. The one that holds a point is walked
    from the cell's lower to its upper corner along the axes in the order of their fractions.

    Attributes:
        corners: Addresses of the four voxels on that way.
        fractions: How far the point is along each of the three edges, the largest first.
    """

    corners: list[Value]
    fractions: Vector


def cell_of(scene: Scene, lattice: Vector) -> Cell:
    """The tetrahedra about lattice coordinates, (point - low) / voxel_m."""
    graph, bricks = scene.graph, scene.tables.bricks
    packed, fraction = None, []
    for axis, coordinate in enumerate(lattice):
        inside = coordinate.clipped(0.0, bricks.index.shape[axis] * BRICK - 1e-3)
        voxel = inside.cast(np.int32)
        fraction.append(inside - voxel.cast(np.float32))
        part = graph.constant(_packed_places(bricks, axis)).take(voxel)
        packed = part if packed is None else packed + part
    assert packed is not None
    # as floats: two bits of the place may be lost, but it never reaches the next block
    block = (packed.cast(np.float32) * (1.0 / (1 << LOCAL_BITS))).cast(np.int32)
    base = packed + _offsets(scene).take(block)
    x, y, z = fraction
    largest, smallest = x.maximum(y, z), x.minimum(y, z)
    middle = (x + y + z) - largest - smallest
    corners = _way(graph, base, fraction, largest, smallest)
    return Cell(corners=corners, fractions=[largest, middle, smallest])


def _packed_places(bricks: Bricks, axis: int) -> np.ndarray:
    """For each voxel along an axis its part of the block's number and of the place inside."""
    voxel = np.arange(bricks.index.shape[axis] * BRICK, dtype=np.int32)
    blocks = int(np.prod(bricks.index.shape[axis + 1 :]))
    packed = (voxel // BRICK * blocks << LOCAL_BITS) + voxel % BRICK * STRIDES[axis]
    return packed.astype(np.int32)


def _offsets(scene: Scene) -> Value:
    """What added to a packed place gives the voxel's address, for each block."""
    offset = scene.columns["brick_offset"]
    blocks = scene.graph.range(scene.graph.constant(np.int32(scene.tables.bricks.index.size)))
    return offset - blocks * (1 << LOCAL_BITS)


def _way(
    graph: Graph, base: Value, fraction: Vector, largest: Value, smallest: Value
) -> list[Value]:
    """The corners of the tetrahedron: the axis of the largest fraction is taken first.

    Where two fractions are the same, the corner between them has no share.
    """
    x, y, _ = fraction
    sx, sy, sz = STRIDES

    def chosen(here: Value, yes: Value | int, no: Value | int) -> Value:
        sides = [graph.value(side, np.int32) for side in (yes, no)]
        return graph.where(here, *sides)

    first = chosen(x.equals(largest), sx, chosen(y.equals(largest), sy, sz))
    last_two = chosen(x.equals(smallest), sy + sz, chosen(y.equals(smallest), sx + sz, sx + sy))
    return [base, base + first, base + last_two, base + (sx + sy + sz)]


def density_in(scene: Scene, cell: Cell) -> Value:
    """Density in 1/m: its logarithm is linear in a tetrahedron; below half a code is nothing."""
    table = scene.columns["voxel_density"]
    codes = [table.take(corner).cast(np.float32) for corner in cell.corners]
    code = codes[0]
    for i, fraction in enumerate(cell.fractions):
        code = code + fraction * (codes[i + 1] - codes[i])
    low, high = LOG_DENSITY
    density = (code * ((high - low) / 255.0) + low).exp()
    return scene.graph.where(code > 0.5, density, 0.0)


def color_in(scene: Scene, cell: Cell) -> Vector:
    """Red, green and blue in [0, 1]."""
    parts = [(part * float(FULL) + 0.5).cast(np.int32) for part in cell.fractions]
    a, b, c = parts
    red_blue = green = None
    for corner, weight in zip(cell.corners, (FULL - a, a - b, b - c, c), strict=True):
        code = scene.columns["voxel_color"].take(corner)
        pair, other = code.masked(0xFF00FF) * weight, code.masked(0xFF00) * weight
        red_blue = pair if red_blue is None else red_blue + pair
        green = other if green is None else green + other
    assert red_blue is not None
    assert green is not None
    scale = 1.0 / (255.0 * FULL)
    blue = red_blue.shifted_right(16)
    red = red_blue - blue.cast(np.int32) * (1 << 16)
    return [
        red.cast(np.float32) * scale,
        green.cast(np.float32) * (scale / 256.0),
        blue.cast(np.float32) * scale,
    ]

"""Nodes that read colour and density out of the bricks."""

from dataclasses import dataclass

import numpy as np

from export.columns import VectorValue
from export.nodes import GraphBuilder, GraphValue
from export.scene import GraphContext
from export.tables import BRICK_SIZE, LOG_DENSITY_RANGE, BRICK_NODES, BrickTable

VOXEL_STRIDES = (BRICK_NODES * BRICK_NODES, BRICK_NODES, 1)
"""Steps along x, y and z inside a brick."""
COLOR_WEIGHT_SCALE = 256
"""Weights of colours are integers that sum to this: two channels share a multiplication."""
VOXEL_OFFSET_BITS = 10
"""A voxel's place inside its brick takes so many bits, the brick's block the others."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BrickTetrahedra:
    """Tetrahedra that hold some points: values of the graph, one entry a point.

    A cell is cut into six tetrahedra along its diagonal. The one that holds a point is walked
    from the cell's lower to its upper corner along the axes in the order of their fractions.

    Attributes:
        corners: Addresses of the four voxels on that way.
        fractions: How far the point is along each of the three edges, the largest first.
    """

    corners: list[GraphValue]
    fractions: VectorValue


def locate_tetrahedra(scene: GraphContext, lattice: VectorValue) -> BrickTetrahedra:
    """The tetrahedra about lattice coordinates, (point - low) / voxel_m."""
    graph, bricks = scene.graph, scene.tables.bricks
    packed, fraction = None, []
    for axis, coordinate in enumerate(lattice):
        inside = coordinate.clip(0.0, bricks.index.shape[axis] * BRICK_SIZE - 1e-3)
        voxel = inside.cast(np.int32)
        fraction.append(inside - voxel.cast(np.float32))
        part = graph.constant(_packed_addresses(bricks, axis)).gather(voxel)
        packed = part if packed is None else packed + part
    assert packed is not None
    # as floats: two bits of the place may be lost, but it never reaches the next block
    block = (packed.cast(np.float32) * (1.0 / (1 << VOXEL_OFFSET_BITS))).cast(np.int32)
    base = packed + _brick_offsets(scene).gather(block)
    x, y, z = fraction
    largest, smallest = x.maximum(y, z), x.minimum(y, z)
    middle = (x + y + z) - largest - smallest
    corners = _tetrahedron_corners(graph, base, fraction, largest, smallest)
    return BrickTetrahedra(corners=corners, fractions=[largest, middle, smallest])


def _packed_addresses(bricks: BrickTable, axis: int) -> np.ndarray:
    """For each voxel along an axis its part of the block's number and of the place inside."""
    voxel = np.arange(bricks.index.shape[axis] * BRICK_SIZE, dtype=np.int32)
    blocks = int(np.prod(bricks.index.shape[axis + 1 :]))
    packed = (voxel // BRICK_SIZE * blocks << VOXEL_OFFSET_BITS) + voxel % BRICK_SIZE * VOXEL_STRIDES[axis]
    return packed.astype(np.int32)


def _brick_offsets(scene: GraphContext) -> GraphValue:
    """What added to a packed place gives the voxel's address, for each block."""
    offset = scene.table_values["brick_offset"]
    blocks = scene.graph.range(scene.graph.constant(np.int32(scene.tables.bricks.index.size)))
    return offset - blocks * (1 << VOXEL_OFFSET_BITS)


def _tetrahedron_corners(
    graph: GraphBuilder, base: GraphValue, fraction: VectorValue, largest: GraphValue, smallest: GraphValue
) -> list[GraphValue]:
    """The corners of the tetrahedron: the axis of the largest fraction is taken first.

    Where two fractions are the same, the corner between them has no share.
    """
    x, y, _ = fraction
    sx, sy, sz = VOXEL_STRIDES

    def chosen(here: GraphValue, yes: GraphValue | int, no: GraphValue | int) -> GraphValue:
        sides = [graph.value(side, np.int32) for side in (yes, no)]
        return graph.where(here, *sides)

    first = chosen(x.equal(largest), sx, chosen(y.equal(largest), sy, sz))
    last_two = chosen(x.equal(smallest), sy + sz, chosen(y.equal(smallest), sx + sz, sx + sy))
    return [base, base + first, base + last_two, base + (sx + sy + sz)]


def interpolate_density(scene: GraphContext, cell: BrickTetrahedra) -> GraphValue:
    """Density in 1/m: its logarithm is linear in a tetrahedron; below half a code is nothing."""
    table = scene.table_values["voxel_density"]
    codes = [table.gather(corner).cast(np.float32) for corner in cell.corners]
    code = codes[0]
    for i, fraction in enumerate(cell.fractions):
        code = code + fraction * (codes[i + 1] - codes[i])
    low, high = LOG_DENSITY_RANGE
    density = (code * ((high - low) / 255.0) + low).exp()
    return scene.graph.where(code > 0.5, density, 0.0)


def interpolate_color(scene: GraphContext, cell: BrickTetrahedra) -> VectorValue:
    """Red, green and blue in [0, 1]."""
    parts = [(part * float(COLOR_WEIGHT_SCALE) + 0.5).cast(np.int32) for part in cell.fractions]
    a, b, c = parts
    red_blue = green = None
    for corner, weight in zip(cell.corners, (COLOR_WEIGHT_SCALE - a, a - b, b - c, c), strict=True):
        code = scene.table_values["voxel_color"].gather(corner)
        pair, other = code.bitwise_and(0xFF00FF) * weight, code.bitwise_and(0xFF00) * weight
        red_blue = pair if red_blue is None else red_blue + pair
        green = other if green is None else green + other
    assert red_blue is not None
    assert green is not None
    scale = 1.0 / (255.0 * COLOR_WEIGHT_SCALE)
    blue = red_blue.shift_right(16)
    red = red_blue - blue.cast(np.int32) * (1 << 16)
    return [
        red.cast(np.float32) * scale,
        green.cast(np.float32) * (scale / 256.0),
        blue.cast(np.float32) * scale,
    ]

"""Nodes that march rays through canonical space and composite the bricks along them."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from export.graph.graph_skinning import (
    GraphContext,
    column,
    dot,
    invert_jacobian,
    locate_skinning_cell,
    skin_points,
)
from export.graph.onnx_builder import GraphBuilder, GraphValue
from export.package.player_tables import BRICK_NODES, BRICK_SIZE, LOG_DENSITY_RANGE, BrickTable

VOXEL_STRIDES = (BRICK_NODES * BRICK_NODES, BRICK_NODES, 1)
"""Steps along x, y and z between addresses inside a brick."""
COLOR_WEIGHT_SCALE = 256
"""Sum of the integer weights of colors, so that two channels share a multiplication."""
VOXEL_OFFSET_BITS = 10
"""Low bits of a packed address, for the voxel in its brick; the others number the block."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BrickTetrahedra:
    """Tetrahedra that contain some points: values of the graph, one entry a point each.

    A cell is cut into six tetrahedra along its diagonal. The one that holds a point is walked
    from the cell's lower to its upper corner along the axes in the order of their fractions.

    Attributes:
        corners: Addresses of the four voxels on that walk.
        fractions: Fraction of the point along each of the three edges, the largest first.
    """

    corners: list[GraphValue]
    fractions: list[GraphValue]


def locate_tetrahedra(context: GraphContext, lattice: GraphValue) -> BrickTetrahedra:
    """Find the tetrahedra about lattice coordinates, (point - low) / voxel_m (3 × points)."""
    graph, bricks = context.graph, context.tables.bricks
    packed, fraction = None, []
    for axis, coordinate in enumerate(lattice.row(axis) for axis in range(3)):
        inside = coordinate.clip(0.0, bricks.index.shape[axis] * BRICK_SIZE - 1e-3)
        voxel = inside.cast(np.int32)
        fraction.append(inside - voxel.cast(np.float32))
        part = graph.constant(_packed_addresses(bricks, axis)).gather(voxel)
        packed = part if packed is None else packed + part
    assert packed is not None
    # divide as floats: rounding loses two bits of the voxel, but never reaches the next block
    block = (packed.cast(np.float32) * (1.0 / (1 << VOXEL_OFFSET_BITS))).cast(np.int32)
    base = packed + _brick_offsets(context).gather(block)
    x, y, z = fraction
    largest, smallest = x.maximum(y, z), x.minimum(y, z)
    middle = (x + y + z) - largest - smallest
    corners = _tetrahedron_corners(graph, base, (x, y), largest, smallest)
    return BrickTetrahedra(corners=corners, fractions=[largest, middle, smallest])


def _packed_addresses(bricks: BrickTable, axis: int) -> np.ndarray:
    """Return each voxel's part of the block's number and of the address inside, along an axis."""
    voxel = np.arange(bricks.index.shape[axis] * BRICK_SIZE, dtype=np.int32)
    blocks = int(np.prod(bricks.index.shape[axis + 1 :]))
    packed = (
        voxel // BRICK_SIZE * blocks << VOXEL_OFFSET_BITS
    ) + voxel % BRICK_SIZE * VOXEL_STRIDES[axis]
    return packed.astype(np.int32)


def _brick_offsets(context: GraphContext) -> GraphValue:
    """Return what turns a packed address into a voxel's address when added, for each block."""
    offset = context.table_values["brick_offset"]
    blocks = context.graph.range(context.graph.constant(np.int32(context.tables.bricks.index.size)))
    return offset - blocks * (1 << VOXEL_OFFSET_BITS)


def _tetrahedron_corners(
    graph: GraphBuilder,
    base: GraphValue,
    fraction: tuple[GraphValue, GraphValue],
    largest: GraphValue,
    smallest: GraphValue,
) -> list[GraphValue]:
    """Return the corners of each tetrahedron, stepping along the largest fraction's axis first.

    Where two fractions are equal, the corner between them has weight 0.
    """
    x, y = fraction
    sx, sy, sz = VOXEL_STRIDES

    def chosen(here: GraphValue, yes: GraphValue | int, no: GraphValue | int) -> GraphValue:
        sides = [graph.value(side, np.int32) for side in (yes, no)]
        return graph.where(here, *sides)

    first = chosen(x.equal(largest), sx, chosen(y.equal(largest), sy, sz))
    last_two = chosen(x.equal(smallest), sy + sz, chosen(y.equal(smallest), sx + sz, sx + sy))
    return [base, base + first, base + last_two, base + (sx + sy + sz)]


def interpolate_density(context: GraphContext, cell: BrickTetrahedra) -> GraphValue:
    """Return density in 1/m, log-linear in each tetrahedron; below half a code it is 0."""
    table = context.table_values["voxel_density"]
    codes = [table.gather(corner).cast(np.float32) for corner in cell.corners]
    code = codes[0]
    for i, fraction in enumerate(cell.fractions):
        code = code + fraction * (codes[i + 1] - codes[i])
    low, high = LOG_DENSITY_RANGE
    density = (code * ((high - low) / 255.0) + low).exp()
    return context.graph.where(code > 0.5, density, 0.0)


def interpolate_color(context: GraphContext, cell: BrickTetrahedra) -> GraphValue:
    """Return red, green and blue in [0, 1], linear in each tetrahedron (3 × points)."""
    parts = [(part * float(COLOR_WEIGHT_SCALE) + 0.5).cast(np.int32) for part in cell.fractions]
    a, b, c = parts
    red_blue = green = None
    for corner, weight in zip(cell.corners, (COLOR_WEIGHT_SCALE - a, a - b, b - c, c), strict=True):
        code = context.table_values["voxel_color"].gather(corner)
        pair, other = code.bitwise_and(0xFF00FF) * weight, code.bitwise_and(0xFF00) * weight
        red_blue = pair if red_blue is None else red_blue + pair
        green = other if green is None else green + other
    assert red_blue is not None
    assert green is not None
    scale = 1.0 / (255.0 * COLOR_WEIGHT_SCALE)
    blue = red_blue.shift_right(16).cast(np.int32)
    sums = context.graph.stack([red_blue - blue * (1 << 16), green, blue])
    return sums.cast(np.float32) * column([scale, scale / 256.0, scale])


class SegmentValues(NamedTuple):
    """Segments of rays: values of the graph, one entry or column a ray.

    Attributes:
        begin, end: Distances from the camera's center, metres.
        direction_camera: Unit directions in the camera's frame.
        start_canonical: Canonical positions at `begin`.
        direction_canonical: Canonical metres per metre along the ray, at `begin`.
    """

    begin: GraphValue
    end: GraphValue
    direction_camera: GraphValue
    start_canonical: GraphValue
    direction_canonical: GraphValue


@dataclass(frozen=True, eq=False, kw_only=True)
class BlockValues:
    """Result of a block of samples: values of the graph, one entry or column a ray.

    Attributes:
        end: End of the block along the ray, metres.
        transmittance: Transmittance of the ray after the block.
        color: Premultiplied color that the block adds.
        path: Where the samples lie (7 × rays): begin and step from one to the next in voxels of the
            brick grid, and that step in metres.
    """

    end: GraphValue
    end_canonical: GraphValue
    transmittance: GraphValue
    color: GraphValue
    path: list[GraphValue]


def march_segments(
    context: GraphContext, posed: GraphValue, segment: SegmentValues, close_up: GraphValue
) -> tuple[GraphValue, GraphValue, list[GraphValue]]:
    """Composite rays front to back; return premultiplied color and transmittance, in [0, 1].

    With `context.traces` also the ray of each block, and the blocks' paths.

    After each block of samples, rays that have ended are dropped; a Newton step moves the others
    back onto their camera rays and updates their directions. The last block takes the rest of a
    ray.
    """
    graph, settings = context.graph, context.settings
    usual = settings.sample_span_m / context.samples.cast(np.float32)
    shortened = compression_scale(context, segment.direction_canonical)
    # more samples than usual make more blocks, not longer ones
    scale = (context.samples + (settings.samples - 1)) // settings.samples
    more = close_up.cast(np.int64)
    blocks, steady = scale * (more + settings.max_blocks), scale * (more + settings.uniform_blocks)
    block = composite_samples(
        context, segment, segment.begin * 0.0 + 1.0, settings.block_samples, usual * shortened
    )
    number = graph.range(graph.size(segment.begin).cast(np.int32))
    traced = [number, graph.concatenate(block.path)] if context.traces else []
    start = [
        block.transmittance,
        block.color,
        *traced,
        *_unfinished_rays(context, number, segment, block),
    ]

    def once(turn: GraphValue, state: list[GraphValue]) -> tuple[GraphValue, list[GraphValue]]:
        light, color, *taken, number, before = state[: len(traced) + 4]
        values = state[len(traced) + 4 :]
        segment = _newton_step(context, posed, SegmentValues(*values))
        doublings = (turn + 2 - steady).maximum(0).cast(np.float32)
        last = turn > blocks - 3
        shortened = compression_scale(context, segment.direction_canonical)
        longest = graph.where(last, settings.max_segment_m, usual * doublings.exp2() * shortened)
        block = composite_samples(context, segment, before, settings.block_samples, longest)
        light = light.scatter(number, block.transmittance)
        color = color.scatter(number.repeat_rows(3), block.color, reduction="add", axis=1)
        if taken:
            path = graph.concatenate([taken[1], graph.concatenate(block.path)], axis=1)
            taken = [graph.concatenate([taken[0], number]), path]
        left = _unfinished_rays(context, number, segment, block)
        return graph.size(left[0]) > 0, [light, color, *taken, *left]

    light, color, *rest = graph.loop_while(blocks - 1, start, once)
    return color, light, rest[: len(traced)]


def compression_scale(context: GraphContext, direction: GraphValue) -> GraphValue:
    """Return the factor, at most 1, by which lengths shrink where the pose compresses space."""
    return (context.settings.max_compression / dot(direction, direction).sqrt()).minimum(1.0)


def _unfinished_rays(
    context: GraphContext, number: GraphValue, segment: SegmentValues, block: BlockValues
) -> list[GraphValue]:
    """Return numbers, transmittances and remainders (`SegmentValues`) of unfinished rays."""
    graph = context.graph
    on = (block.transmittance > context.settings.min_transmittance) & (
        block.end < segment.end - 1e-5
    )
    chosen = graph.range(graph.size(on).cast(np.int32)).compress(on)
    vectors = chosen.repeat_rows(3)
    return [
        *(v.gather(chosen) for v in (number, block.transmittance, block.end, segment.end)),
        *(
            v.gather_columns(vectors)
            for v in (segment.direction_camera, block.end_canonical, segment.direction_canonical)
        ),
    ]


def composite_samples(
    context: GraphContext,
    segment: SegmentValues,
    light: GraphValue,
    num_samples: int,
    max_spacing: GraphValue | float,
) -> BlockValues:
    """Sample density `num_samples` times and color once, at the mean of what is seen."""
    graph, bricks = context.graph, context.tables.bricks
    step = ((segment.end - segment.begin) * (1.0 / num_samples)).minimum(max_spacing)
    scale = 1.0 / bricks.voxel_m
    start = segment.start_canonical * scale - column(bricks.low * scale)
    slope = segment.direction_canonical * (step * scale)
    middles = np.arange(num_samples) + 0.5
    lattice = slope.reshape(3, 1, -1) * column(middles) + start.reshape(3, 1, -1)
    density = interpolate_density(context, locate_tetrahedra(context, lattice.reshape(3, -1)))
    depth = density.reshape(num_samples, -1) * -step
    after = graph.node("CumSum", depth, graph.constant(np.int64(0))).exp() * light
    passed = after.row(num_samples - 1)
    # the sum of what samples absorb, times their numbers and a half, by parts
    shares = np.where(middles < middles[-1], 1.0, -middles[-1])
    weight, mean = light - passed, after.weighted_sum(shares) + light * 0.5
    middle = mean / weight.maximum(1e-9)
    seen = interpolate_color(context, locate_tetrahedra(context, start + slope * middle))
    way = step * float(num_samples)
    return BlockValues(
        end=segment.begin + way,
        end_canonical=segment.start_canonical + segment.direction_canonical * way,
        transmittance=passed,
        color=seen * weight,
        path=[start, slope, step.reshape(1, -1)],
    )


def _newton_step(context: GraphContext, posed: GraphValue, segment: SegmentValues) -> SegmentValues:
    """Move canonical positions onto their camera rays where skinning is invertible."""
    graph, settings = context.graph, context.settings
    camera, derivative = skin_points(
        context, posed, locate_skinning_cell(context, segment.start_canonical)
    )
    inverse = invert_jacobian(context, derivative)
    along_ray = inverse.apply(segment.direction_camera)
    shift = inverse.apply(segment.direction_camera * segment.begin - camera)
    length = (dot(shift, shift) + 1e-20).sqrt()
    share = graph.where(inverse.trusted, (settings.max_correction_m / length).minimum(1.0), 0.0)
    return segment._replace(
        start_canonical=segment.start_canonical + shift * share,
        direction_canonical=graph.where(inverse.trusted, along_ray, segment.direction_canonical),
    )

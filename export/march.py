"""Nodes that follow rays through canonical space, and gather colour on the way."""

from dataclasses import dataclass

import numpy as np

from export.columns import VectorValue, adjugate, dot, gather_vector
from export.lookup import locate_tetrahedra, interpolate_color, interpolate_density
from export.nodes import GraphValue
from export.posing import PosedNodeValues, skin_points, invert_jacobian, locate_skinning_cell
from export.scene import GraphContext

MIN_REMAINING_M = 1e-5


@dataclass(frozen=True, eq=False, kw_only=True)
class SegmentValues:
    """Pieces of rays: values of the graph, one entry a ray.

    Attributes:
        ray: Directions in the camera's frame, of length 1.
        begin, end: Along the ray, metres.
        canonical: Where the beginning lies in canonical space.
        direction: Canonical metres a metre of the ray, at the beginning.
    """

    direction_camera: VectorValue
    begin: GraphValue
    end: GraphValue
    start_canonical: VectorValue
    direction_canonical: VectorValue


@dataclass(frozen=True, eq=False, kw_only=True)
class BlockValues:
    """What a block of samples leaves behind: values of the graph, one entry a ray.

    Attributes:
        place: Where it ends along the ray, metres.
        canonical: The same in canonical space.
        light: What is let through.
        color: What it adds, premultiplied.
    """

    end: GraphValue
    end_canonical: VectorValue
    transmittance: GraphValue
    color: VectorValue


def march_segments(scene: GraphContext, posed: PosedNodeValues, segment: SegmentValues) -> tuple[VectorValue, GraphValue]:
    """Front-to-back compositing, a block of samples at a time.

    After each block the rays that have ended are put aside, and the others are led back to where
    the skin says that they are: a step of Newton's method, which also turns them. The last block
    takes all that is left of a ray.

    Args:
        scene: What is drawn.
        posed: The skin's nodes in the camera's frame.
        segment: The rays.

    Returns:
        Premultiplied colour, and the light that is left, in [0, 1].
    """
    graph, rules = scene.graph, scene.settings
    usual = rules.sample_span_m / scene.samples.cast(np.float32)
    shortened = compression_scale(scene, segment.direction_canonical)
    scale = (scene.samples + (rules.samples - 1)) // rules.samples  # more samples, more blocks
    blocks, steady = (scale * count for count in (rules.max_blocks, rules.uniform_blocks))
    block = composite_samples(scene, segment, segment.begin * 0.0 + 1.0, rules.block_samples, usual * shortened)
    number = graph.range(graph.size(segment.begin).cast(np.int32))
    start = [block.transmittance, *block.color, *_unfinished_rays(scene, number, segment, block)]

    def once(turn: GraphValue, state: list[GraphValue]) -> tuple[GraphValue, list[GraphValue]]:
        (light, *color), number, before, values = state[:4], state[4], state[5], state[6:]
        segment = _newton_step(scene, posed, _unpack_segment(values))
        doublings = (turn + 2 - steady).maximum(0).cast(np.float32)
        last = turn > blocks - 3
        shortened = compression_scale(scene, segment.direction_canonical)
        longest = graph.where(last, rules.max_segment_m, usual * doublings.exp2() * shortened)
        block = composite_samples(scene, segment, before, rules.block_samples, longest)
        light = light.scatter(number, block.transmittance)
        color = [
            c.scatter(number, added, reduction="add")
            for c, added in zip(color, block.color, strict=True)
        ]
        left = _unfinished_rays(scene, number, segment, block)
        return graph.size(left[0]) > 0, [light, *color, *left]

    light, *color = graph.loop_while(blocks - 1, start, once)[:4]
    return color, light


def compression_scale(scene: GraphContext, direction: VectorValue) -> GraphValue:
    """Factor by which lengths along rays shrink where the pose compresses canonical space."""
    return (scene.settings.max_compression / dot(direction, direction).sqrt()).minimum(1.0)


def _unfinished_rays(scene: GraphContext, number: GraphValue, segment: SegmentValues, block: BlockValues) -> list[GraphValue]:
    """Which rays go on: their numbers, the light that is left, and `_pack_segment` of their rest."""
    graph = scene.graph
    on = (block.transmittance > scene.settings.min_transmittance) & (block.end < segment.end - MIN_REMAINING_M)
    chosen = graph.range(graph.size(on).cast(np.int32)).compress(on)
    rest = SegmentValues(
        direction_camera=segment.direction_camera,
        begin=block.end,
        end=segment.end,
        start_canonical=block.end_canonical,
        direction_canonical=segment.direction_canonical,
    )
    return gather_vector([number, block.transmittance, *_pack_segment(rest)], chosen)


def _unpack_segment(values: list[GraphValue]) -> SegmentValues:
    return SegmentValues(
        direction_camera=values[:3],
        begin=values[3],
        end=values[4],
        start_canonical=values[5:8],
        direction_canonical=values[8:],
    )


def _pack_segment(segment: SegmentValues) -> list[GraphValue]:
    return [
        *segment.direction_camera, segment.begin, segment.end, *segment.start_canonical, *segment.direction_canonical
    ]  # fmt: skip


def composite_samples(
    scene: GraphContext, segment: SegmentValues, light: GraphValue, num_samples: int, max_spacing: GraphValue | float
) -> BlockValues:
    """A block of so many samples: density at each, colour once, at their mean."""
    graph, bricks = scene.graph, scene.tables.bricks
    step = ((segment.end - segment.begin) * (1.0 / num_samples)).minimum(max_spacing)
    scale = 1.0 / bricks.voxel_m
    start = [
        p * scale - float(low) * scale for p, low in zip(segment.start_canonical, bricks.low, strict=True)
    ]
    along_step = step * scale
    slope = [d * along_step for d in segment.direction_canonical]
    middles = graph.constant((np.arange(num_samples, dtype=np.float32) + 0.5)[:, None])
    lattice = [
        (middles * b.reshape(1, -1) + a.reshape(1, -1)).reshape(-1)
        for a, b in zip(start, slope, strict=True)
    ]
    density = interpolate_density(scene, locate_tetrahedra(scene, lattice)).reshape(num_samples, -1)
    passed = graph.split((density * -step.reshape(1, -1)).exp(), num_samples)
    weight = mean = None
    before = light
    for turn, share in enumerate(passed):
        light = before * share
        seen = before - light
        part = seen * (turn + 0.5)
        weight = seen if weight is None else weight + seen
        mean = part if mean is None else mean + part
        before = light
    assert weight is not None
    assert mean is not None
    middle = mean / weight.maximum(1e-9)
    seen = interpolate_color(
        scene, locate_tetrahedra(scene, [a + middle * b for a, b in zip(start, slope, strict=True)])
    )
    way = step * float(num_samples)
    return BlockValues(
        end=segment.begin + way,
        end_canonical=[p + d * way for p, d in zip(segment.start_canonical, segment.direction_canonical, strict=True)],
        transmittance=light,
        color=[c * weight for c in seen],
    )


def _newton_step(scene: GraphContext, posed: PosedNodeValues, segment: SegmentValues) -> SegmentValues:
    """Corrects canonical points and directions where the derivative can be inverted."""
    graph, rules = scene.graph, scene.settings
    camera, derivative = skin_points(scene, posed, locate_skinning_cell(scene, segment.start_canonical))
    inverse = invert_jacobian(scene, derivative, adjugate(derivative))
    off = [segment.begin * r - c for r, c in zip(segment.direction_camera, camera, strict=True)]
    shift = inverse.apply(off)
    length = (dot(shift, shift) + 1e-20).sqrt()
    share = (rules.max_correction_m / length).minimum(1.0)
    turned = inverse.apply(segment.direction_camera)
    return SegmentValues(
        direction_camera=segment.direction_camera,
        begin=segment.begin,
        end=segment.end,
        start_canonical=[p + s * share for p, s in zip(segment.start_canonical, shift, strict=True)],
        direction_canonical=[
            graph.where(inverse.trusted, a, b)
            for a, b in zip(turned, segment.direction_canonical, strict=True)
        ],
    )

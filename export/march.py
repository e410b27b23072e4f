"""Nodes that follow rays through canonical space, and gather colour on the way."""

from dataclasses import dataclass

import numpy as np

from export.columns import Vector, adjugate, dot, taken
from export.lookup import cell_of, color_in, density_in
from export.nodes import Value
from export.posing import Posed, carried, inverse_of, place_of
from export.scene import Scene

NOTHING_LEFT_M = 1e-5


@dataclass(frozen=True, eq=False, kw_only=True)
class Segment:
    """Pieces of rays: values of the graph, one entry a ray.

    Attributes:
        ray: Directions in the camera's frame, of length 1.
        begin, end: Along the ray, metres.
        canonical: Where the beginning lies in canonical space.
        direction: Canonical metres a metre of the ray, at the beginning.
    """

    ray: Vector
    begin: Value
    end: Value
    canonical: Vector
    direction: Vector


@dataclass(frozen=True, eq=False, kw_only=True)
class Block:
    """What a block of samples leaves behind: values of the graph, one entry a ray.

    Attributes:
        place: Where it ends along the ray, metres.
        canonical: The same in canonical space.
        light: What is let through.
        color: What it adds, premultiplied.
    """

    place: Value
    canonical: Vector
    light: Value
    color: Vector


def march(scene: Scene, posed: Posed, segment: Segment) -> tuple[Vector, Value]:
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
    graph, rules = scene.graph, scene.rules
    usual = rules.span_m / scene.samples.cast(np.float32)
    shortened = unsquashed(scene, segment.direction)
    scale = (scene.samples + (rules.samples - 1)) // rules.samples  # more samples, more blocks
    blocks, steady = (scale * count for count in (rules.blocks, rules.steady))
    block = sampled(scene, segment, segment.begin * 0.0 + 1.0, rules.block, usual * shortened)
    number = graph.range(graph.size(segment.begin).cast(np.int32))
    start = [block.light, *block.color, *_going_on(scene, number, segment, block)]

    def once(turn: Value, state: list[Value]) -> tuple[Value, list[Value]]:
        (light, *color), number, before, values = state[:4], state[4], state[5], state[6:]
        segment = _led_back(scene, posed, _segment(values))
        doublings = (turn + 2 - steady).maximum(0).cast(np.float32)
        last = turn > blocks - 3
        shortened = unsquashed(scene, segment.direction)
        longest = graph.where(last, rules.longest_m, usual * doublings.exp2() * shortened)
        block = sampled(scene, segment, before, rules.block, longest)
        light = light.scattered(number, block.light)
        color = [
            c.scattered(number, added, reduction="add")
            for c, added in zip(color, block.color, strict=True)
        ]
        left = _going_on(scene, number, segment, block)
        return graph.size(left[0]) > 0, [light, *color, *left]

    light, *color = graph.loop_while(blocks - 1, start, once)[:4]
    return color, light


def unsquashed(scene: Scene, direction: Vector) -> Value:
    """Factor by which lengths along rays shrink where the pose compresses canonical space."""
    return (scene.rules.squash_limit / dot(direction, direction).sqrt()).minimum(1.0)


def _going_on(scene: Scene, number: Value, segment: Segment, block: Block) -> list[Value]:
    """Which rays go on: their numbers, the light that is left, and `_values` of their rest."""
    graph = scene.graph
    on = (block.light > scene.rules.ended) & (block.place < segment.end - NOTHING_LEFT_M)
    chosen = graph.range(graph.size(on).cast(np.int32)).compressed(on)
    rest = Segment(
        ray=segment.ray,
        begin=block.place,
        end=segment.end,
        canonical=block.canonical,
        direction=segment.direction,
    )
    return taken([number, block.light, *_values(rest)], chosen)


def _segment(values: list[Value]) -> Segment:
    return Segment(
        ray=values[:3],
        begin=values[3],
        end=values[4],
        canonical=values[5:8],
        direction=values[8:],
    )


def _values(segment: Segment) -> list[Value]:
    return [
        *segment.ray, segment.begin, segment.end, *segment.canonical, *segment.direction
    ]  # fmt: skip


def sampled(
    scene: Scene, segment: Segment, light: Value, count: int, longest: Value | float
) -> Block:
    """A block of so many samples: density at each, colour once, at their mean."""
    graph, bricks = scene.graph, scene.tables.bricks
    step = ((segment.end - segment.begin) * (1.0 / count)).minimum(longest)
    scale = 1.0 / bricks.voxel_m
    start = [
        p * scale - float(low) * scale for p, low in zip(segment.canonical, bricks.low, strict=True)
    ]
    along_step = step * scale
    slope = [d * along_step for d in segment.direction]
    middles = graph.constant((np.arange(count, dtype=np.float32) + 0.5)[:, None])
    lattice = [
        (middles * b.reshaped(1, -1) + a.reshaped(1, -1)).reshaped(-1)
        for a, b in zip(start, slope, strict=True)
    ]
    density = density_in(scene, cell_of(scene, lattice)).reshaped(count, -1)
    passed = graph.split((density * -step.reshaped(1, -1)).exp(), count)
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
    seen = color_in(
        scene, cell_of(scene, [a + middle * b for a, b in zip(start, slope, strict=True)])
    )
    way = step * float(count)
    return Block(
        place=segment.begin + way,
        canonical=[p + d * way for p, d in zip(segment.canonical, segment.direction, strict=True)],
        light=light,
        color=[c * weight for c in seen],
    )


def _led_back(scene: Scene, posed: Posed, segment: Segment) -> Segment:
    """Corrects canonical points and directions where the derivative can be inverted."""
    graph, rules = scene.graph, scene.rules
    camera, derivative = carried(scene, posed, place_of(scene, segment.canonical))
    inverse = inverse_of(scene, derivative, adjugate(derivative))
    off = [segment.begin * r - c for r, c in zip(segment.ray, camera, strict=True)]
    shift = inverse.applied(off)
    length = (dot(shift, shift) + 1e-20).sqrt()
    share = (rules.longest_correction_m / length).minimum(1.0)
    turned = inverse.applied(segment.ray)
    return Segment(
        ray=segment.ray,
        begin=segment.begin,
        end=segment.end,
        canonical=[p + s * share for p, s in zip(segment.canonical, shift, strict=True)],
        direction=[
            graph.where(inverse.trusted, a, b)
            for a, b in zip(turned, segment.direction, strict=True)
        ],
    )

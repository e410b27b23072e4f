"""Nodes that follow rays through canonical space, and gather colour on the way."""

from dataclasses import dataclass

import numpy as np

from export.columns import Matrix, Vector, adjugate, applied, dot, taken
from export.lookup import FULL, read_bricks
from export.nodes import Value
from export.posing import Posed, carried, determinant, sound
from export.scene import Scene

MOST_BLOCKS = 64
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


def march(scene: Scene, posed: Posed, segment: Segment, *, steady: int) -> tuple[Vector, Value]:
    """Front-to-back compositing, a block of samples at a time.

    After each block the rays that have ended are put aside, and the others are led back to where
    the skin says that they are: a step of Newton's method, which also turns them.

    Args:
        scene: What is drawn.
        posed: The skin's nodes in the camera's frame.
        segment: The rays.
        steady: So many blocks have steps of the usual length; then each has twice the last one's.

    Returns:
        Premultiplied colour and alpha in [0, 1].
    """
    graph, nothing = scene.graph, segment.begin * 0.0
    count = graph.node("Size", nothing, dtype=np.int64)
    zero, one = graph.constant(np.int64(0)), graph.constant(np.int64(1))
    number = graph.node("Range", zero, count, one)
    moving = [segment.begin, *segment.canonical, *segment.direction]

    def block(turn: Value, state: list[Value]) -> tuple[Value, list[Value]]:
        results, (number, *now) = state[:4], state[4:]
        rays = taken(segment.ray, number)
        end = segment.end.take(number)
        doublings = (turn.cast(np.float32) - float(steady - 1)).maximum(0.0)
        longest = scene.rules.span_m / scene.samples.cast(np.float32) * doublings.exp2()
        now = _sampled(scene, now, end, longest)
        light, place = now[7], now[0]
        going = (light > scene.rules.ended) & (place < end - NOTHING_LEFT_M)
        ended = graph.nonzero(graph.node("Not", going))
        target = number.take(ended)
        results = [
            result.scattered(target, value.take(ended))
            for result, value in zip(results, now[7:], strict=True)
        ]
        left = graph.nonzero(going)
        now, rays = taken(now, left), taken(rays, left)
        some = graph.node("Size", left, dtype=np.int64) > 0
        return some, [*results, number.take(left), *_led_back(scene, posed, rays, now)]

    start = [*[nothing] * 4, number, *moving, nothing + 1.0, *[nothing] * 3]
    light, *color = graph.loop_while(MOST_BLOCKS, start, block)[:4]
    return [component * (1.0 / (255.0 * FULL)) for component in color], 1.0 - light


def _sampled(scene: Scene, state: list[Value], end: Value, longest: Value) -> list[Value]:
    """Goes on for a block of samples; the state is place, point, direction, light, colour."""
    place, point, direction, carried_on = state[0], state[1:4], state[4:7], state[7:]
    rules, bricks = scene.rules, scene.tables.bricks
    step = ((end - place) * (1.0 / rules.block)).minimum(longest)
    scale = 1.0 / bricks.voxel_m
    start = [(p - float(low)) * scale for p, low in zip(point, bricks.low, strict=True)]
    slope = [component * step * scale for component in direction]

    def sample(turn: Value, state: list[Value]) -> list[Value]:
        light, *color = state
        along = turn.cast(np.float32) + 0.5
        lattice = [a + along * b for a, b in zip(start, slope, strict=True)]
        sampled, density = read_bricks(scene.graph, scene.columns, bricks, lattice)
        passed = (-(density * step)).exp()
        weight = light * (1.0 - passed)
        return [light * passed, *(a + b * weight for a, b in zip(color, sampled, strict=True))]

    carried_on = scene.graph.loop(scene.graph.constant(np.int64(rules.block)), carried_on, sample)
    way = step * float(rules.block)
    point = [p + d * way for p, d in zip(point, direction, strict=True)]
    return [place + way, *point, *direction, *carried_on]


def _led_back(scene: Scene, posed: Posed, ray: Vector, state: list[Value]) -> list[Value]:
    """Corrects canonical points and directions where the derivative can be inverted."""
    graph, rules = scene.graph, scene.rules
    place, point, direction, others = state[0], state[1:4], state[4:7], state[7:]
    camera, derivative = carried(scene, posed, point)
    cofactors: Matrix = adjugate(derivative)
    volume = determinant(derivative, cofactors)
    trusted = sound(scene, volume)
    inverse = graph.where(trusted, volume, 1.0).reciprocal()
    off = [place * r - c for r, c in zip(ray, camera, strict=True)]
    shift = [component * inverse for component in applied(cofactors, off)]
    longest = rules.longest_correction_m
    length = (dot(shift, shift) + 1e-20).sqrt()
    share = graph.where(trusted, (longest / length).minimum(1.0), 0.0)
    point = [p + s * share for p, s in zip(point, shift, strict=True)]
    turned = [component * inverse for component in applied(cofactors, ray)]
    direction = [graph.where(trusted, a, b) for a, b in zip(turned, direction, strict=True)]
    return [place, *point, *direction, *others]

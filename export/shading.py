"""Nodes that follow each pixel's ray into canonical space and gather colour there."""

from dataclasses import dataclass

import numpy as np

from export.columns import Matrix, Vector, adjugate, applied, dot, taken
from export.lookup import FULL, read_bricks
from export.nodes import Value
from export.raster import FAR, Hull
from export.scene import Scene, View
from export.tables import GRADIENT_LIMIT, SURFEL_BITS


@dataclass(frozen=True, eq=False, kw_only=True)
class Layer:
    """One depth layer: values of the graph, one entry a covered pixel.

    Attributes:
        pixel: Which pixel.
        color: Premultiplied.
        alpha: In [0, 1].
        depth: Where the ray's segment begins, metres along z.
    """

    pixel: Value
    color: Vector
    alpha: Value
    depth: Value


@dataclass(frozen=True, eq=False, kw_only=True)
class Seen:
    """What a pixel sees: values of the graph, one entry a covered pixel.

    Attributes:
        surfel: Its number.
        canonical, normal: Its canonical position and normal.
        camera: Its position in the camera's frame.
    """

    surfel: Value
    canonical: Vector
    normal: Vector
    camera: Vector


@dataclass(frozen=True, eq=False, kw_only=True)
class Segment:
    """A piece of a straight canonical ray: point(t) = origin + t · direction, t in posed metres."""

    origin: Vector
    direction: Vector
    begin: Value
    length: Value


def shade(scene: Scene, hull: Hull, keys: Value, wanted: Value) -> Layer:
    """Colour and alpha of every pixel that is `wanted` and covered.

    The map from canonical space to the camera's is taken as linear about the surfel that the
    pixel sees; its inverse carries the ray into canonical space.
    """
    pixel = scene.graph.nonzero((keys < FAR) & wanted)
    surfel = keys.take(pixel).masked((1 << SURFEL_BITS) - 1)
    seen = Seen(
        surfel=surfel,
        canonical=taken(hull.canonical, surfel),
        normal=taken(hull.normal, surfel),
        camera=taken(hull.camera, surfel),
    )
    inverse = local_inverse(scene, hull, seen)
    ray = _rays(scene.view, pixel)
    direction, to_surfel = applied(inverse, ray), applied(inverse, seen.camera)
    begin, length = _extent(scene, seen, direction, to_surfel, dot(seen.camera, ray))
    segment = Segment(
        origin=[a - b for a, b in zip(seen.canonical, to_surfel, strict=True)],
        direction=direction,
        begin=begin,
        length=length,
    )
    color, alpha = march(scene, segment)
    return Layer(pixel=pixel, color=color, alpha=alpha, depth=begin * ray[2])


def local_inverse(scene: Scene, hull: Hull, seen: Seen) -> Matrix:
    """Inverse of the derivative of linear blend skinning at each pixel's surfel.

    With y(c) = Σ w_k(c) B_k c the derivative is Σ w_k B_k + Σ (B_k c - y) ∇w_kᵀ. Subtracting y,
    which changes nothing in exact numbers, keeps the rounding of the stored gradients from being
    multiplied by the distance to the camera. Where the whole is out of shape, in the folds of
    extreme poses, the first sum has to do.
    """
    graph, rules = scene.graph, scene.rules
    blended = [[row[j].take(seen.surfel) for j in range(3)] for row in hull.camera_from_canonical]
    gradient = scene.columns["skin_gradient"].take_rows(seen.surfel).cast(np.float32)
    ones = graph.constant(np.ones((24, 1), dtype=np.float32))
    bones = graph.concatenated([scene.view.bones, ones], axis=1) * (GRADIENT_LIMIT / 127.0)
    terms = gradient.reshaped(-1, 24).matmul(bones).reshaped(-1, 39).transposed(1, 0)
    full: Matrix = [[] for _ in range(3)]
    for axis in range(3):  # of the gradient; each has 12 sums over B_k and one over 1
        sums = [terms.row(13 * axis + entry) for entry in range(13)]
        for i in range(3):
            lever = dot(sums[4 * i : 4 * i + 3], seen.canonical) + sums[4 * i + 3]
            full[i].append(blended[i][axis] + lever - sums[12] * seen.camera[i])
    volume = _determinant(full)
    sound = (volume > 1.0 / rules.stretch) & (volume < rules.stretch)
    mixed = [
        [graph.where(sound, a, b) for a, b in zip(rows, others, strict=True)]
        for rows, others in zip(full, blended, strict=True)
    ]
    cofactors = adjugate(mixed)
    scale = dot(mixed[0], [row[0] for row in cofactors]).reciprocal()
    return [[entry * scale for entry in row] for row in cofactors]


def _determinant(matrix: Matrix) -> Value:
    (a, b, c), (d, e, f), (g, h, i) = matrix
    return a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)


def _rays(view: View, pixel: Value) -> Vector:
    """Unit directions through the pixels' centres in the camera's frame."""
    number = pixel.cast(np.int32)
    width = view.width.cast(np.int32)
    row = number // width
    column = number - row * width
    x = (column.cast(np.float32) + 0.5 - view.center[0]) / view.focal[0]
    y = (row.cast(np.float32) + 0.5 - view.center[1]) / view.focal[1]
    scale = (x * x + y * y + 1.0).sqrt().reciprocal()
    return [x * scale, y * scale, scale]


def _extent(
    scene: Scene, seen: Seen, direction: Vector, to_surfel: Vector, along: Value
) -> tuple[Value, Value]:
    """Where the ray enters the hull's tangent plane, and how far it is followed from there."""
    graph, rules, normal = scene.graph, scene.rules, seen.normal
    thickness = scene.columns["thickness"].take(seen.surfel)
    falling = dot(normal, direction)
    shallow = -0.5 * rules.steepest
    hit = dot(normal, to_surfel) / falling.minimum(shallow)
    begin = graph.where(falling < shallow, hit, along)
    begin = begin.minimum(along + rules.slack_m).maximum(along - rules.slack_m)
    cosine = (-falling).maximum(rules.steepest)
    lead = (rules.lead_m / cosine).minimum(rules.most_lead_m)
    sine = 1.0 - falling * falling / dot(direction, direction)
    length = thickness * (sine * rules.grazing + 1.0) / cosine
    return begin - lead, (length + lead).minimum(rules.longest_m)


def march(scene: Scene, segment: Segment) -> tuple[Vector, Value]:
    """Front-to-back compositing of equal steps along the segment (a Loop: any number of them).

    Returns:
        Premultiplied colour and alpha in [0, 1].
    """
    graph, bricks, samples = scene.graph, scene.tables.bricks, scene.samples
    step = segment.length / samples.cast(np.float32)
    scale = 1.0 / bricks.voxel_m
    start = [
        (origin - float(low)) * scale
        for origin, low in zip(segment.origin, bricks.low, strict=True)
    ]
    slope = [component * scale for component in segment.direction]

    def advance(turn: Value, state: list[Value]) -> list[Value]:
        transmittance, *color = state
        distance = segment.begin + step * (turn.cast(np.float32) + 0.5)
        lattice = [a + distance * b for a, b in zip(start, slope, strict=True)]
        sampled, density = read_bricks(graph, scene.columns, bricks, lattice)
        passed = (-(density * step)).exp()
        weight = transmittance * (1.0 - passed)
        summed = [a + b * weight for a, b in zip(color, sampled, strict=True)]
        return [transmittance * passed, *summed]

    nothing = step * 0.0
    transmittance, *color = graph.loop(samples, [nothing + 1.0, *[nothing] * 3], advance)
    return [component * (1.0 / (255.0 * FULL)) for component in color], 1.0 - transmittance

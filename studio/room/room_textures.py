"""What the faces of a room are covered with: patterns that never repeat, and some that only do.

The rich ones follow the dead-leaves model: shapes of all sizes that hide each other, as in pictures
of the world, have corners at every scale (Lee, Mumford and Huang 2001).
"""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

TexturePainter = Callable[
    [tuple[int, int], float, np.random.Generator], UInt8[np.ndarray, "rows columns 3"]
]
"""Paints a face, given its size in texels (columns, rows) and the texel size in meters."""

LEAF_SIZES_M = (0.012, 0.45)
"""The smallest and the largest leaf."""
SUBPIXEL_BITS = 4
"""OpenCV draws at this many binary places behind the point."""


def plaster(color: tuple[int, int, int], contrast: float = 13.0) -> TexturePainter:
    """A wall: faint leaves of one color, stains, and pictures that hang on it."""

    def paint(size, texel_m, generator):
        picture = _paint_dead_leaves(
            size, texel_m, generator, np.array(color, dtype=float), contrast
        )
        picture = _add_stains(picture, texel_m, generator, 9.0)
        width, height = size[0] * texel_m, size[1] * texel_m
        for _ in range(int(width / 0.9)):
            wide, tall = generator.uniform(0.25, 0.8), generator.uniform(0.25, 0.7)
            left = generator.uniform(0.05, max(width - wide, 0.06))
            top = generator.uniform(0.25, max(height - tall - 0.5, 0.26))
            _hang_print(picture, texel_m, (left, top), (wide, tall), generator)
        return picture

    return paint


def planks(color: tuple[int, int, int]) -> TexturePainter:
    """A wooden floor: boards of all lengths and tones with grain and knots, and a rug."""

    def paint(size, texel_m, generator):
        columns, rows = size
        tone = np.ones((rows, columns), dtype=np.float32)
        wide = max(round(0.13 / texel_m), 2)
        for left in range(0, columns, wide):
            top = -int(generator.uniform(0.0, 1.5) / texel_m)
            while top < rows:
                below = top + max(int(generator.uniform(0.5, 1.7) / texel_m), 2)
                board = tone[max(top, 0) : max(below, 0), left : left + wide]
                board *= generator.uniform(0.72, 1.2)
                board[-1:] *= 0.55
                board[:, -1:] *= 0.6
                top = below
        fine = _noise((rows, columns), (0.20 / texel_m, 0.008 / texel_m), generator)
        wild = _noise((rows, columns), (0.03 / texel_m, 0.02 / texel_m), generator)
        tone *= 1.0 + 0.10 * fine + 0.07 * wild
        picture = _to_uint8(tone[..., None] * np.array(color, dtype=np.float32))
        knots = int(columns * rows * texel_m**2 * 6)
        for x, y in generator.uniform(0.0, 1.0, (knots, 2)) * size:
            radius = generator.uniform(0.006, 0.022) / texel_m
            axes = (max(round(radius), 1), max(round(radius * generator.uniform(1.0, 2.0)), 1))
            dark = tuple(int(c * generator.uniform(0.35, 0.7)) for c in color)
            cv2.ellipse(picture, (int(x), int(y)), axes, 0.0, 0.0, 360.0, dark, -1, cv2.LINE_AA)
        left, right, top, below = 0.22 * columns, 0.80 * columns, 0.16 * rows, 0.62 * rows
        rug = picture[int(top) : int(below), int(left) : int(right)]
        rug[:] = _paint_dead_leaves(
            rug.shape[1::-1], texel_m, generator, np.array((128.0, 84.0, 78.0)), 24.0
        )
        return _add_stains(picture, texel_m, generator, 5.0)

    return paint


def dead_leaves(color: tuple[int, int, int], contrast: float = 30.0) -> TexturePainter:
    """A face of leaves around one color: a painted box, a cloth."""

    def paint(size, texel_m, generator):
        picture = _paint_dead_leaves(
            size, texel_m, generator, np.array(color, dtype=float), contrast
        )
        return _add_stains(picture, texel_m, generator, 6.0)

    return paint


def wood(color: tuple[int, int, int]) -> TexturePainter:
    """A board with grain, drawers and handles."""

    def paint(size, texel_m, generator):
        columns, rows = size
        grain = _noise((rows, columns), (0.010 / texel_m, 0.25 / texel_m), generator)
        wild = _noise((rows, columns), (0.02 / texel_m, 0.03 / texel_m), generator)
        tone = 1.0 + 0.11 * grain + 0.08 * wild
        picture = _to_uint8(tone[..., None] * np.array(color, dtype=np.float32))
        steps = max(round(rows * texel_m / generator.uniform(0.25, 0.4)), 1)
        dark = tuple(int(0.45 * c) for c in color)
        thick = max(round(0.006 / texel_m), 1)
        for step in range(1, steps):
            row = rows * step // steps
            cv2.line(picture, (0, row), (columns, row), dark, thick)
            at = (int(columns * generator.uniform(0.3, 0.7)), row - rows // (2 * steps))
            cv2.circle(picture, at, max(round(0.02 / texel_m), 1), (214, 206, 190), -1, cv2.LINE_AA)
        return picture

    return paint


def books(color: tuple[int, int, int]) -> TexturePainter:
    """Shelves full of books with printed backs."""

    def paint(size, texel_m, generator):
        columns, rows = size
        picture = np.full((rows, columns, 3), np.array(color) * 0.45, dtype=np.uint8)
        shelves = max(round(rows * texel_m / 0.32), 1)
        for shelf in range(shelves):
            below = rows * (shelf + 1) // shelves - max(round(0.02 / texel_m), 1)
            above = rows * shelf // shelves
            column = 1
            while column < columns - 2:
                thick = max(int(generator.uniform(0.015, 0.06) / texel_m), 2)
                top = below - int((below - above) * generator.uniform(0.55, 0.95))
                back = picture[top:below, column : min(column + thick, columns - 1)]
                ink = generator.uniform(50.0, 190.0) + generator.uniform(-45.0, 45.0, 3)
                back[:] = _paint_dead_leaves(back.shape[1::-1], texel_m, generator, ink, 34.0)
                back[:, :1] = back[:, :1] // 2
                column += thick
            picture[below : below + max(round(0.02 / texel_m), 1)] = color
        return picture

    return paint


def repeat_motif(
    motif: TexturePainter, period_m: float, grout: tuple[int, int, int]
) -> TexturePainter:
    """One square motif over and over, every copy the same to the last bit."""

    def paint(size, texel_m, generator):
        side = max(round(period_m / texel_m), 4)
        one = motif((side, side), texel_m, generator).copy()
        line = max(side // 40, 1)
        one[:line], one[:, :line] = grout, grout
        times = (-(-size[1] // side), -(-size[0] // side), 1)
        return np.ascontiguousarray(np.tile(one, times)[: size[1], : size[0]])

    return paint


def _paint_dead_leaves(
    size: tuple[int, int],
    texel_m: float,
    generator: np.random.Generator,
    color: Float[np.ndarray, "3"],
    contrast: float,
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Shapes that hide each other, sizes by a power law, colors around one."""
    columns, rows = size
    picture = np.full((rows, columns, 3), np.clip(color, 0, 255), dtype=np.uint8)
    low, high = LEAF_SIZES_M[0], min(LEAF_SIZES_M[1], 0.5 * max(size) * texel_m + LEAF_SIZES_M[0])
    area = columns * rows * texel_m**2
    count = int(min(area * 900.0, 60_000)) + 4
    # The number of leaves above a radius falls with its square, so that every scale covers alike.
    drawn = generator.uniform(high**-2.0, low**-2.0, count) ** -0.5
    drawn[: count // 8] = np.geomspace(high, 4.0 * low, count // 8)  # the ground is covered
    radii = drawn / texel_m * 2**SUBPIXEL_BITS
    places = generator.uniform(0.0, 1.0, (count, 2)) * size * 2**SUBPIXEL_BITS
    tones = color + contrast * generator.standard_normal((count, 1))
    tones = np.clip(tones + 0.3 * contrast * generator.standard_normal((count, 3)), 4, 251)
    angles = np.sort(generator.uniform(0.0, 2.0 * np.pi, (count, 5)), axis=1)
    rings = np.stack([np.cos(angles), np.sin(angles)], axis=-1) * radii[:, None, None]
    polygons = (places[:, None] + rings).astype(np.int32)
    for i in range(count):
        ink = tuple(tones[i].tolist())
        if i % 3:
            corners = polygons[i, : 3 + i % 3]
            cv2.fillConvexPoly(picture, corners, ink, cv2.LINE_AA, SUBPIXEL_BITS)
        else:
            middle = (int(places[i, 0]), int(places[i, 1]))
            cv2.circle(picture, middle, int(0.7 * radii[i]), ink, -1, cv2.LINE_AA, SUBPIXEL_BITS)
    return picture


def _hang_print(
    picture: UInt8[np.ndarray, "rows columns 3"],
    texel_m: float,
    corner_m: tuple[float, float],
    size_m: tuple[float, float],
    generator: np.random.Generator,
) -> None:
    """A framed print on a wall."""
    left, top = (int(at / texel_m) for at in corner_m)
    wide, tall = (max(int(at / texel_m), 2) for at in size_m)
    edge = max(round(0.02 / texel_m), 1)
    part = picture[top : top + tall, left : left + wide]
    if part.shape[0] <= 2 * edge or part.shape[1] <= 2 * edge:
        return
    part[:] = generator.integers(20, 90, 3)
    inner = part[edge:-edge, edge:-edge]
    ink = generator.uniform(70.0, 190.0, 3)
    inner[:] = _paint_dead_leaves(inner.shape[1::-1], texel_m, generator, ink, 55.0)


def _add_stains(
    picture: UInt8[np.ndarray, "rows columns 3"],
    texel_m: float,
    generator: np.random.Generator,
    strength: float,
) -> UInt8[np.ndarray, "rows columns 3"]:
    """The picture with stains of every size."""
    stains = np.zeros(picture.shape[:2], dtype=np.float32)
    for scale in (0.6, 0.2, 0.06, 0.02, 0.007):
        each = scale / texel_m
        if each >= 1.0:
            stains += _noise(picture.shape[:2], (each, each), generator)
    return _to_uint8(picture + strength * stains[..., None])


def _noise(
    shape: tuple[int, int], grain: tuple[float, float], generator: np.random.Generator
) -> Float32[np.ndarray, "rows columns"]:
    """Smooth noise of about unit variance; `grain` is its size in texels down and across."""
    coarse = [max(2, int(np.ceil(n / max(g, 1.0)))) + 1 for n, g in zip(shape, grain, strict=True)]
    white = generator.standard_normal(coarse).astype(np.float32)
    return cv2.resize(white, shape[::-1], interpolation=cv2.INTER_CUBIC)


def _to_uint8(picture: Float32[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    return np.clip(picture, 0.0, 255.0).astype(np.uint8)

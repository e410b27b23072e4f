"""Painted things: the backdrop behind the actor, and the patterns on the faces of a room.

A backdrop is a plain wall or a cluttered room, with the shadow on the floor. Of the patterns some
never repeat, and some only do. The rich ones follow the dead-leaves model: shapes of all sizes that
hide each other, as in pictures of the world, have corners at every scale (Lee, Mumford and Huang
2001).
"""

from collections.abc import Callable
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from capture.camera import Camera

Rgb = UInt8[np.ndarray, "height width 3"]
Backdrop = Literal["plain", "clutter"]

SUPERSAMPLING = 3
"""Factor by which the backdrop is painted larger before it is reduced."""


def paint_backdrop(kind: Backdrop, camera: Camera, generator: np.random.Generator) -> Rgb:
    """The empty studio, as the camera sees it: wall and floor, cluttered or plain."""
    width, height = camera.size_px
    floor = _floor_row(camera)
    large = np.zeros((height * SUPERSAMPLING, width * SUPERSAMPLING, 3), dtype=np.uint8)
    horizon = int(np.clip(floor * SUPERSAMPLING, 0, height * SUPERSAMPLING))
    large[:horizon] = (214, 207, 196) if kind == "plain" else (176, 187, 178)
    large[horizon:] = (188, 178, 164) if kind == "plain" else (150, 116, 84)
    if kind == "clutter":
        _furnish(large, horizon, generator)
    small = cv2.resize(large, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    y, x = np.mgrid[0:height, 0:width] / max(width, height)
    small *= (1.06 - 0.22 * np.hypot(x - 0.42, y - 0.35))[..., None]
    grain = generator.normal(0.0, 1.2, (height, width, 1))
    return np.clip(small + grain, 0.0, 255.0).astype(np.uint8)


def add_foot_shadows(
    background: Rgb,
    feet_world: Float[np.ndarray, "feet 3"],
    camera: Camera,
) -> Rgb:
    """The backdrop with soft shadows on the floor around points of the feet."""
    height, width = background.shape[:2]
    on_floor = feet_world * np.array([1.0, 0.0, 1.0])
    at = camera.project(on_floor)
    across = camera.project(on_floor + np.array([0.22, 0.0, 0.0]))[:, 0] - at[:, 0]
    deep = camera.project(on_floor + np.array([0.0, 0.0, 0.24]))[:, 1] - at[:, 1]
    y, x = np.mgrid[0:height, 0:width] + 0.5
    light: Float32[np.ndarray, "height width"] = np.ones((height, width), dtype=np.float32)
    for (column, row), wide, tall in zip(at, np.abs(across), np.abs(deep), strict=True):
        far = ((x - column) / wide) ** 2 + ((y - row) / tall) ** 2
        light *= (1.0 - 0.30 * np.exp(-2.0 * far)).astype(np.float32)
    return (background * light[..., None]).astype(np.uint8)


def _floor_row(camera: Camera) -> float:
    """Return the row in which the wall, 1.5 m behind the actor, meets the floor."""
    return float(camera.project(np.array([0.0, 0.0, -1.5]))[1])


def _furnish(large: Rgb, horizon: int, generator: np.random.Generator) -> None:
    """Planks, a shelf of books, pictures, a window, a plant, a lamp."""
    width = large.shape[1]
    _planks(large, horizon, generator)
    unit = width / 100.0
    cv2.rectangle(large, (0, horizon - int(2 * unit)), (width, horizon), (226, 222, 212), -1)
    _shelf(large, (int(2 * unit), int(horizon - 58 * unit)), int(24 * unit), horizon, generator)
    _window(large, (int(66 * unit), int(8 * unit)), (int(25 * unit), int(36 * unit)))
    for left, top, wide, tall in ((29, 6, 11, 14), (42, 4, 9, 11), (31, 24, 8, 10), (54, 7, 8, 12)):
        x, y = left + generator.uniform(-0.6, 0.6), top + generator.uniform(-0.6, 0.6)
        size = (int(wide * unit), int(tall * unit))
        _picture(large, (int(x * unit), int(y * unit)), size, generator)
    _plant(large, (int(86 * unit), horizon), unit, generator)


def _planks(large: Rgb, horizon: int, generator: np.random.Generator) -> None:
    height, width = large.shape[:2]
    vanish = np.array([width * 0.5, horizon - height * 0.45])
    for k in range(-14, 14):
        edge = [width * 0.5 + (k + s) * width * 0.14 for s in (0, 1)]
        polygon = np.array([[edge[0], height], [edge[1], height], vanish], dtype=np.int32)
        shade = generator.uniform(0.85, 1.12)
        mask = np.zeros(large.shape[:2], dtype=np.uint8)
        cv2.fillPoly(mask, [polygon], 255)
        mask[:horizon] = 0
        large[mask > 0] = np.clip(np.array([156, 118, 84]) * shade, 0, 255)


def _shelf(
    large: Rgb,
    corner: tuple[int, int],
    wide: int,
    floor: int,
    generator: np.random.Generator,
) -> None:
    left, top = corner
    cv2.rectangle(large, (left, top), (left + wide, floor), (104, 74, 52), -1)
    rows = 5
    tall = (floor - top) // rows
    for row in range(rows):
        y0, y1 = top + row * tall + wide // 20, top + (row + 1) * tall
        cv2.rectangle(
            large, (left + wide // 24, y0), (left + wide - wide // 24, y1), (58, 42, 32), -1
        )
        x = left + wide // 20
        while x < left + wide - wide // 7:
            thick = int(generator.uniform(0.05, 0.12) * wide)
            lower = y0 + int(generator.uniform(0.05, 0.35) * tall)
            color = tuple(int(c) for c in generator.integers(45, 225, 3))
            cv2.rectangle(large, (x, lower), (x + thick - 2, y1), color, -1)
            x += thick
        cv2.line(large, (left, y1), (left + wide, y1), (128, 94, 66), max(wide // 30, 1))


def _window(large: Rgb, corner: tuple[int, int], size: tuple[int, int]) -> None:
    (x, y), (wide, tall) = corner, size
    cv2.rectangle(large, (x, y), (x + wide, y + tall), (240, 238, 230), -1)
    frame = max(wide // 14, 1)
    sky = np.linspace(0.0, 1.0, max(tall - 2 * frame, 1))[:, None, None]
    view = (1.0 - sky) * np.array([148, 190, 226]) + sky * np.array([214, 226, 220])
    large[y + frame : y + tall - frame, x + frame : x + wide - frame] = view.astype(np.uint8)
    hill = np.array(
        [(x + frame, y + tall - frame), (x + frame, y + int(tall * 0.72)),
         (x + int(wide * 0.45), y + int(tall * 0.58)), (x + wide - frame, y + int(tall * 0.78)),
         (x + wide - frame, y + tall - frame)], dtype=np.int32,
    )  # fmt: skip
    cv2.fillPoly(large, [hill], (118, 152, 104))
    cv2.line(large, (x + wide // 2, y), (x + wide // 2, y + tall), (240, 238, 230), frame)
    cv2.line(large, (x, y + tall // 2), (x + wide, y + tall // 2), (240, 238, 230), frame)


def _picture(
    large: Rgb,
    corner: tuple[int, int],
    size: tuple[int, int],
    generator: np.random.Generator,
) -> None:
    (x, y), (wide, tall) = corner, size
    cv2.rectangle(large, (x, y), (x + wide, y + tall), (52, 46, 44), -1)
    edge = max(wide // 12, 1)
    cv2.rectangle(
        large, (x + edge, y + edge), (x + wide - edge, y + tall - edge), (236, 230, 218), -1
    )
    for _ in range(6):
        radius = int(generator.uniform(0.08, 0.26) * wide)
        middle = (
            int(generator.uniform(x + edge + radius, x + wide - edge - radius)),
            int(generator.uniform(y + edge + radius, y + tall - edge - radius)),
        )
        cv2.circle(large, middle, radius, tuple(int(c) for c in generator.integers(50, 235, 3)), -1)


def _plant(large: Rgb, foot: tuple[int, int], unit: float, generator: np.random.Generator) -> None:
    x, floor = foot
    for _ in range(46):
        angle = generator.uniform(-1.2, 1.2)
        reach = generator.uniform(14, 32) * unit
        tip = (int(x + np.sin(angle) * reach * 0.6), int(floor - 10 * unit - np.cos(angle) * reach))
        green = (int(generator.integers(36, 84)), int(generator.integers(96, 150)), 62)
        size = (max(int(3.4 * unit), 1), max(int(1.5 * unit), 1))
        cv2.line(large, (x, floor - int(9 * unit)), tip, (72, 96, 52), max(int(0.4 * unit), 1))
        cv2.ellipse(large, tip, size, float(np.rad2deg(angle) + 60), 0, 360, green, -1)
    pot = np.array(
        [(x - 5, floor - 11), (x + 5, floor - 11), (x + 4, floor + 3), (x - 4, floor + 3)]
    )
    scaled = [x, floor] + (pot - [x, floor]) * unit
    cv2.fillPoly(large, [scaled.astype(np.int32)], (190, 98, 66))


TexturePainter = Callable[[tuple[int, int], float, np.random.Generator], Rgb]
"""Paints a face, given its size in texels (columns, rows) and the texel size in meters."""

LEAF_SIZES_M = (0.012, 0.45)
"""Smallest and largest leaf."""
SUBPIXEL_BITS = 4
"""Fractional bits of the coordinates that OpenCV draws at."""


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
) -> Rgb:
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
    picture: Rgb,
    texel_m: float,
    corner_m: tuple[float, float],
    size_m: tuple[float, float],
    generator: np.random.Generator,
) -> None:
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
    picture: Rgb,
    texel_m: float,
    generator: np.random.Generator,
    strength: float,
) -> Rgb:
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

"""The painted backdrop behind the actor: a plain wall or a cluttered room, and foot shadows."""

from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Float32

from capture.camera import Camera
from capture.source import RgbImage

Backdrop = Literal["plain", "clutter"]

SUPERSAMPLING = 3
"""Factor by which the backdrop is painted larger before it is reduced."""


def paint_backdrop(kind: Backdrop, camera: Camera, generator: np.random.Generator) -> RgbImage:
    """The empty studio, as the camera sees it: wall and floor, cluttered or plain."""
    width, height = camera.size_px
    floor = float(camera.project(np.array([0.0, 0.0, -1.5]))[1])  # of a wall 1.5 m behind
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
    background: RgbImage, feet_world: Float[np.ndarray, "feet 3"], camera: Camera
) -> RgbImage:
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


def _furnish(large: RgbImage, horizon: int, generator: np.random.Generator) -> None:
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


def _planks(large: RgbImage, horizon: int, generator: np.random.Generator) -> None:
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
    large: RgbImage, corner: tuple[int, int], wide: int, floor: int, generator: np.random.Generator
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


def _window(large: RgbImage, corner: tuple[int, int], size: tuple[int, int]) -> None:
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
    large: RgbImage, corner: tuple[int, int], size: tuple[int, int], generator: np.random.Generator
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


def _plant(
    large: RgbImage, foot: tuple[int, int], unit: float, generator: np.random.Generator
) -> None:
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

"""What colours the person has, vertex by vertex, learnt where the surface faces the camera.

A pixel of the border is a mixture, and two pixels farther in the person may look different: a sole
below a shoe, a collar, a stripe. But who turns shows each part of the surface from the front once.
"""

from typing import NamedTuple, final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from capture.camera import Camera
from preprocess.masks.shell import ClothedBody

MIN_FACING_COSINE = 0.5
"""AppearanceModel are learnt where the cosine between normal and ray is greater."""
MIN_INSIDE_PX = 2.0
"""And where the mask's border is farther away than this."""
RIM_COSINES = -0.3, 0.6
"""Vertices between these cosines show their colour along the outline."""

DEPTH_CELL_PX = 2
"""So large are the pixels in which it is seen which vertex hides which."""
OCCLUSION_SLACK_M = 0.06
"""What is so much deeper than the nearest vertex beside it is hidden."""

COLOR_BLUR_PX = 1.0
"""How far around it a vertex tells the colour (a Gaussian's σ)."""
COLOR_MARGIN_PX, MIN_COLOR_WEIGHT = 6, 1e-4
"""Farther away, and where so little is told, nothing is."""
KNOWN_VIEW_WEIGHT = 1.0
"""A vertex seen so often from the front is known."""
MIN_COLOR_SPREAD = 8.0
"""AppearanceModel are never surer than this, in levels."""
UNSEEN_COLOR_SPREAD = 30.0
"""And this sure where only neighbours are known."""


class VertexVisibility(NamedTuple):
    """How a camera sees the vertices of the shell.

    Attributes:
        pixels: Where, in pixels.
        facing: The cosine between normal and ray; negative if it looks away.
        seen: Whether nothing nearer hides it.
    """

    pixels: Float[np.ndarray, "vertices 2"]
    facing: Float[np.ndarray, "vertices"]
    visible: Bool[np.ndarray, "vertices"]

    @classmethod
    def of(cls, clothed: ClothedBody, camera: Camera) -> "Sight":
        """The sight of a shell, every vertex lifted by its thickness."""
        points = clothed.skin + clothed.normals * clothed.offset_m[:, None]
        rays = camera.center_world - points
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        pixels = camera.project(points)
        depth = points @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
        size = tuple(each // DEPTH_CELL_PX + 1 for each in camera.size_px)
        column, row = np.clip((pixels / DEPTH_CELL_PX).astype(int), 0, np.array(size) - 1).T
        nearest = np.full(size[::-1], np.inf, dtype=np.float32)
        np.minimum.at(nearest, (row, column), depth.astype(np.float32))
        nearest = cv2.erode(nearest, np.ones((3, 3), np.uint8))
        return cls(
            pixels=pixels,
            facing=np.einsum("va,va->v", clothed.normals, rays),
            seen=depth < nearest[row, column] + OCCLUSION_SLACK_M,
        )


@final
class AppearanceModel:
    """The colours of one person's surface."""

    def __init__(self, count: int) -> None:
        """Nothing is known yet of so many vertices."""
        self._seen = np.zeros(count)
        self._sums = np.zeros((count, 4))  # of red, green, blue, and of their squares' mean

    def update(
        self,
        visibility: VertexVisibility,
        rgb: UInt8[np.ndarray, "height width 3"],
        inside_px: Float32[np.ndarray, "height width"],
    ) -> None:
        """Takes in what a picture shows of the vertices that face the camera.

        Args:
            sight: How the camera sees them.
            rgb: The picture.
            inside_px: How far each pixel is inside the person.
        """
        facing = np.flatnonzero(visibility.visible & (visibility.facing > MIN_FACING_COSINE))
        x, y = (visibility.pixels[facing] - 0.5).astype(np.float32).T.reshape(2, -1, 1)
        inside = cv2.remap(inside_px, x, y, cv2.INTER_LINEAR)[:, 0] > MIN_INSIDE_PX
        colours = cv2.remap(rgb, x, y, cv2.INTER_LINEAR).reshape(-1, 3)[inside].astype(np.float64)
        facing = facing[inside]
        weight = visibility.facing[facing] ** 2
        self._seen[facing] += weight
        self._sums[facing, :3] += weight[:, None] * colours
        self._sums[facing, 3] += weight * (colours**2).mean(axis=1)

    def predict(
        self, visibility: VertexVisibility, size_px: tuple[int, int]
    ) -> tuple[Float32[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]]:
        """The colour that the person should have in each pixel along the outline, and its spread.

        Far from all known vertices of the rim the spread is infinite.
        """
        width, height = size_px
        colour = np.zeros((height, width, 3), dtype=np.float32)
        spread = np.full((height, width), np.inf, dtype=np.float32)
        low, high = RIM_COSINES
        rim = visibility.visible & (visibility.facing > low) & (visibility.facing < high)
        rim &= ((visibility.pixels >= 0.0) & (visibility.pixels < size_px)).all(axis=1)
        if rim.any():
            column, row = visibility.pixels[rim].astype(int).T
            box = np.s_[max(0, row.min() - COLOR_MARGIN_PX) : row.max() + COLOR_MARGIN_PX,
                        max(0, column.min() - COLOR_MARGIN_PX) : column.max() + COLOR_MARGIN_PX]  # fmt: skip
            rows, columns = spread[box].shape
            flat = (row - box[0].start) * columns + column - box[1].start
            laid = self._splat(flat, rim, rows * columns).reshape(rows, columns, 6)
            colour[box], spread[box] = _interpolate_colors(laid)
        return colour, spread

    def _splat(
        self, pixels: Int[np.ndarray, "rim"], rim: Bool[np.ndarray, "vertices"], count: int
    ) -> Float32[np.ndarray, "count 6"]:
        """Sums over the vertices in each pixel: colour, square, known vertices, and all."""
        seen = self._seen[rim]
        known = np.minimum(seen / KNOWN_VIEW_WEIGHT, 1.0)
        mean = self._sums[rim] / np.maximum(seen, 1e-9)[:, None]
        told = [*(known * mean.T), known, np.ones(len(known))]
        planes = [np.bincount(pixels, each, minlength=count) for each in told]
        return np.stack(planes, axis=-1).astype(np.float32)


def _interpolate_colors(
    splatted: Float32[np.ndarray, "rows columns 6"],
) -> tuple[Float32[np.ndarray, "rows columns 3"], Float32[np.ndarray, "rows columns"]]:
    """SrgbColor and spread around what vertices tell."""
    splatted = cv2.GaussianBlur(splatted, (0, 0), COLOR_BLUR_PX)
    told = np.maximum(splatted[..., 4], np.float32(MIN_COLOR_WEIGHT))
    mean = splatted[..., :4] / told[..., None]
    variance = np.maximum(mean[..., 3] - (mean[..., :3] ** 2).mean(axis=-1), np.float32(0.0))
    share = splatted[..., 4] / np.maximum(splatted[..., 5], np.float32(MIN_COLOR_WEIGHT))
    spread = np.sqrt(variance + np.float32(MIN_COLOR_SPREAD**2))
    spread += (np.float32(1.0) - share) * np.float32(UNSEEN_COLOR_SPREAD)
    return mean[..., :3], np.where(splatted[..., 4] > MIN_COLOR_WEIGHT, spread, np.float32(np.inf))

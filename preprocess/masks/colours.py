"""What colours the person has, vertex by vertex, learnt where the surface faces the camera.

A pixel of the border is a mixture, and two pixels farther in the person may look different: a sole
below a shoe, a collar, a stripe. But who turns shows each part of the surface from the front once.
"""

from typing import NamedTuple, final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from capture.camera import Camera
from preprocess.masks.shell import Around

FACING = 0.5
"""Colours are learnt where the cosine between normal and ray is greater."""
INSIDE_PX = 2.0
"""And where the mask's border is farther away than this."""
RIM = -0.3, 0.6
"""Vertices between these cosines show their colour along the outline."""

DEPTH_PX = 2
"""So large are the pixels in which it is seen which vertex hides which."""
HIDDEN_M = 0.06
"""What is so much deeper than the nearest vertex beside it is hidden."""

REACH_PX = 1.0
"""How far around it a vertex tells the colour (a Gaussian's σ)."""
FAR_PX, LEAST_TOLD = 6, 1e-4
"""Farther away, and where so little is told, nothing is."""
ENOUGH = 1.0
"""A vertex seen so often from the front is known."""
LEAST_SPREAD = 8.0
"""Colours are never surer than this, in levels."""
UNKNOWN_SPREAD = 30.0
"""And this sure where only neighbours are known."""


class Sight(NamedTuple):
    """How a camera sees the vertices of the shell.

    Attributes:
        pixels: Where, in pixels.
        facing: The cosine between normal and ray; negative if it looks away.
        seen: Whether nothing nearer hides it.
    """

    pixels: Float[np.ndarray, "vertices 2"]
    facing: Float[np.ndarray, "vertices"]
    seen: Bool[np.ndarray, "vertices"]

    @classmethod
    def of(cls, around: Around, camera: Camera) -> "Sight":
        """The sight of a shell, every vertex lifted by its thickness."""
        points = around.skin + around.normals * around.thickness[:, None]
        rays = camera.center_world - points
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        pixels = camera.project(points)
        depth = points @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
        size = tuple(each // DEPTH_PX + 1 for each in camera.size_px)
        column, row = np.clip((pixels / DEPTH_PX).astype(int), 0, np.array(size) - 1).T
        nearest = np.full(size[::-1], np.inf, dtype=np.float32)
        np.minimum.at(nearest, (row, column), depth.astype(np.float32))
        nearest = cv2.erode(nearest, np.ones((3, 3), np.uint8))
        return cls(
            pixels=pixels,
            facing=np.einsum("va,va->v", around.normals, rays),
            seen=depth < nearest[row, column] + HIDDEN_M,
        )


@final
class Colours:
    """The colours of one person's surface."""

    def __init__(self, count: int) -> None:
        """Nothing is known yet of so many vertices."""
        self._seen = np.zeros(count)
        self._sums = np.zeros((count, 4))  # of red, green, blue, and of their squares' mean

    def learn(
        self,
        sight: Sight,
        rgb: UInt8[np.ndarray, "height width 3"],
        inside_px: Float32[np.ndarray, "height width"],
    ) -> None:
        """Takes in what a picture shows of the vertices that face the camera.

        Args:
            sight: How the camera sees them.
            rgb: The picture.
            inside_px: How far each pixel is inside the person.
        """
        facing = np.flatnonzero(sight.seen & (sight.facing > FACING))
        x, y = (sight.pixels[facing] - 0.5).astype(np.float32).T.reshape(2, -1, 1)
        inside = cv2.remap(inside_px, x, y, cv2.INTER_LINEAR)[:, 0] > INSIDE_PX
        colours = cv2.remap(rgb, x, y, cv2.INTER_LINEAR).reshape(-1, 3)[inside].astype(np.float64)
        facing = facing[inside]
        weight = sight.facing[facing] ** 2
        self._seen[facing] += weight
        self._sums[facing, :3] += weight[:, None] * colours
        self._sums[facing, 3] += weight * (colours**2).mean(axis=1)

    def along(
        self, sight: Sight, size_px: tuple[int, int]
    ) -> tuple[Float32[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]]:
        """The colour that the person should have in each pixel along the outline, and its spread.

        Far from all known vertices of the rim the spread is infinite.
        """
        width, height = size_px
        colour = np.zeros((height, width, 3), dtype=np.float32)
        spread = np.full((height, width), np.inf, dtype=np.float32)
        low, high = RIM
        rim = sight.seen & (sight.facing > low) & (sight.facing < high)
        rim &= ((sight.pixels >= 0.0) & (sight.pixels < size_px)).all(axis=1)
        if rim.any():
            column, row = sight.pixels[rim].astype(int).T
            box = np.s_[max(0, row.min() - FAR_PX) : row.max() + FAR_PX,
                        max(0, column.min() - FAR_PX) : column.max() + FAR_PX]  # fmt: skip
            rows, columns = spread[box].shape
            flat = (row - box[0].start) * columns + column - box[1].start
            laid = self._laid(flat, rim, rows * columns).reshape(rows, columns, 6)
            colour[box], spread[box] = _blurred(laid)
        return colour, spread

    def _laid(
        self, pixels: Int[np.ndarray, "rim"], rim: Bool[np.ndarray, "vertices"], count: int
    ) -> Float32[np.ndarray, "count 6"]:
        """Sums over the vertices in each pixel: colour, square, known vertices, and all."""
        seen = self._seen[rim]
        known = np.minimum(seen / ENOUGH, 1.0)
        mean = self._sums[rim] / np.maximum(seen, 1e-9)[:, None]
        told = [*(known * mean.T), known, np.ones(len(known))]
        planes = [np.bincount(pixels, each, minlength=count) for each in told]
        return np.stack(planes, axis=-1).astype(np.float32)


def _blurred(
    laid: Float32[np.ndarray, "rows columns 6"],
) -> tuple[Float32[np.ndarray, "rows columns 3"], Float32[np.ndarray, "rows columns"]]:
    """Colour and spread around what vertices tell."""
    laid = cv2.GaussianBlur(laid, (0, 0), REACH_PX)
    told = np.maximum(laid[..., 4], np.float32(LEAST_TOLD))
    mean = laid[..., :4] / told[..., None]
    variance = np.maximum(mean[..., 3] - (mean[..., :3] ** 2).mean(axis=-1), np.float32(0.0))
    share = laid[..., 4] / np.maximum(laid[..., 5], np.float32(LEAST_TOLD))
    spread = np.sqrt(variance + np.float32(LEAST_SPREAD**2))
    spread += (np.float32(1.0) - share) * np.float32(UNKNOWN_SPREAD)
    return mean[..., :3], np.where(laid[..., 4] > LEAST_TOLD, spread, np.float32(np.inf))

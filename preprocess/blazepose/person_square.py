"""A square around a person, turned so that the person stands upright in it.

BlazePose (Bazarevsky et al. 2020, arXiv:2006.10204) describes where a person is by a circle: its
middle is that of the hips, and it encloses the whole body. The square stands around that circle, a
quarter wider.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

MARGIN = 1.25
"""Side of the square, in diameters of the circle."""


@dataclass(frozen=True, kw_only=True)
class PersonSquare:
    """A turned square in a frame; the first pixel's middle is at (0.5, 0.5).

    Attributes:
        x, y: Its middle, pixels.
        side: Length of its sides, pixels.
        angle: Turn from upright, radians, clockwise as seen in the picture.
    """

    x: float
    y: float
    side: float
    angle: float = 0.0

    @classmethod
    def around(
        cls, hips: Float[np.ndarray, "2"], above_head: Float[np.ndarray, "2"]
    ) -> "PersonSquare":
        """The square of a person.

        Args:
            hips: Middle of the hips, pixels.
            above_head: The point of the circle around the person that lies above the head.
        """
        x, y = (above_head - hips).tolist()
        return cls(
            x=float(hips[0]),
            y=float(hips[1]),
            side=float(2 * MARGIN * np.hypot(x, y)),
            angle=float(np.arctan2(x, -y)),
        )

    @classmethod
    def of_frame(cls, rgb: UInt8[np.ndarray, "height width 3"]) -> "PersonSquare":
        """The upright square around a whole frame."""
        height, width = rgb.shape[:2]
        return cls(x=width / 2, y=height / 2, side=float(max(width, height)))

    def image_from_crop(self, size: int) -> Float[np.ndarray, "2 3"]:
        """The affine map from pixels of a crop of `size` x `size` pixels to pixels of the frame."""
        turn = self.rotation() * (self.side / size)
        middle = np.array([self.x, self.y])
        return np.column_stack([turn, middle - turn @ np.full(2, size / 2)])

    def rotation(self) -> Float[np.ndarray, "2 2"]:
        """From directions in the square to directions in the frame."""
        cosine, sine = np.cos(self.angle), np.sin(self.angle)
        return np.array([[cosine, -sine], [sine, cosine]])

    def crop(
        self, rgb: UInt8[np.ndarray, "height width 3"], size: int
    ) -> UInt8[np.ndarray, "size size 3"]:
        """Cut the square out of a frame, `size` x `size` pixels; black outside the frame."""
        there = self.image_from_crop(size)
        corners = there @ np.array([[0, size, 0, size], [0, 0, size, size], [1, 1, 1, 1]])
        # Large squares are halved, thirded, … first: a pixel of the crop shall see all it covers.
        block = max(1, int(self.side / size))
        height, width = rgb.shape[:2]
        low = np.clip(corners.min(axis=1) - 2, 0, None).astype(int) // block * block
        high = np.minimum((width, height), np.ceil(corners.max(axis=1) + 2).astype(int))
        blocks = (high - low) // block
        if (blocks <= 0).any():
            return np.zeros((size, size, 3), np.uint8)
        end = low + blocks * block
        part = rgb[low[1] : end[1], low[0] : end[0]]
        if block > 1:
            part = cv2.resize(part, tuple(blocks.tolist()), interpolation=cv2.INTER_AREA)
        there[:, 2] -= low
        there /= block
        there[:, 2] += 0.5 * there[:, :2].sum(axis=1) - 0.5  # to OpenCV's pixels, middles at 0
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(part, there, (size, size), flags=flags)

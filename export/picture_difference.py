"""Straight, premultiplied and composited pictures, and how far two of them differ."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8

MAX_CLOSE_DIFFERENCE = 2
"""Largest difference of a premultiplied channel between pixels that count as close, in 1/255."""
MIN_CLOSE_FRACTION = 0.999
"""Least fraction of close pixels between pictures that count as the same."""


@dataclass(frozen=True, kw_only=True)
class PictureDifference:
    """How far two premultiplied pictures differ.

    Attributes:
        largest_difference: Over all pixels and channels, in 1/255.
        close_fraction: Fraction of the pixels that differ by at most `MAX_CLOSE_DIFFERENCE`.
    """

    largest_difference: float
    close_fraction: float

    @classmethod
    def of(
        cls, a: Float32[np.ndarray, "height width 4"], b: Float32[np.ndarray, "height width 4"]
    ) -> "PictureDifference":
        """Compare two premultiplied pictures in [0, 1]."""
        difference = np.abs(a - b).max(axis=-1) * 255.0
        return cls(
            largest_difference=float(difference.max()),
            close_fraction=float((difference <= MAX_CLOSE_DIFFERENCE).mean()),
        )

    @property
    def matches(self) -> bool:
        """Whether they count as the same picture."""
        return self.close_fraction >= MIN_CLOSE_FRACTION


def premultiply(
    rgba: UInt8[np.ndarray, "height width 4"],
) -> Float32[np.ndarray, "height width 4"]:
    """Convert a straight 8-bit picture to premultiplied floats in [0, 1]."""
    picture = rgba.astype(np.float32) / np.float32(255.0)
    picture[..., :3] *= picture[..., 3:]
    return picture


def picture_on_white(
    premultiplied: Float32[np.ndarray, "*pixels 4"],
) -> Float32[np.ndarray, "*pixels 3"]:
    """Composite premultiplied pixels over white, clipped to [0, 1]."""
    return np.clip(premultiplied[..., :3] + (1.0 - premultiplied[..., 3:]), 0.0, 1.0)

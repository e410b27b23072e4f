"""What a person's clothes look like: tells two persons apart where their places do not."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from preprocess.tracking.keypoints import PersonKeypoints

SHOULDERS, HIPS, KNEES = (11, 12), (23, 24), (25, 26)
"""Numbers of key points, left and right."""
ACROSS = np.linspace(0.2, 0.8, 8)
ALONG = np.linspace(0.1, 0.9, 12)
"""Where colors are taken: shares of the way from left to right, and downwards."""
QUANTILES = (0.15, 0.5, 0.85)
"""Quantiles of the colors that are compared: stripes differ from one color of the same mean."""
LEARNING_RATE = 0.15
"""Share of a new picture in what is remembered."""


class PersonLooks:
    """Remembers the colors of one person's chest and thighs."""

    def __init__(self) -> None:
        """Knows no person yet."""
        self._colors = np.zeros(2 * len(QUANTILES) * 3)
        self._pictures = 0

    @property
    def is_known(self) -> bool:
        """Whether there is anything to compare with."""
        return self._pictures > 0

    def distance(self, colors: Float[np.ndarray, "numbers"]) -> float:
        """How unlike the person's the colors are: the mean difference, in units of CIELAB."""
        return float(np.abs(colors - self._colors).mean())

    def learn(self, colors: Float[np.ndarray, "numbers"]) -> None:
        """Remember the colors of a picture that shows the person."""
        self._pictures += 1
        self._colors += max(LEARNING_RATE, 1 / self._pictures) * (colors - self._colors)


def colors_of(
    rgb: UInt8[np.ndarray, "height width 3"], found: PersonKeypoints
) -> Float[np.ndarray, "numbers"]:
    """Quantiles of the colors of a person's chest and thighs in a frame, CIELAB."""
    points = found.image_px
    height, width = rgb.shape[:2]
    colors = []
    for upper, lower in ((SHOULDERS, HIPS), (HIPS, KNEES)):
        rows = [
            points[upper[0]] + ALONG[:, None] * (points[lower[0]] - points[upper[0]]),
            points[upper[1]] + ALONG[:, None] * (points[lower[1]] - points[upper[1]]),
        ]
        grid = (rows[0] + ACROSS[:, None, None] * (rows[1] - rows[0])).reshape(-1, 2)
        columns, lines = np.clip(grid.astype(int), 0, (width - 1, height - 1)).T
        lab = cv2.cvtColor(rgb[lines, columns][None].astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
        colors.append(np.quantile(lab[0], QUANTILES, axis=0).ravel())
    return np.concatenate(colors).astype(np.float64)

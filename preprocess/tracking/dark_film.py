"""Brightening of dark films, before networks and mask refinement, whose limits are in levels."""

from typing import final

import cv2
import numpy as np
from jaxtyping import UInt8

DARK_LEVEL, BRIGHT_LEVEL = 80.0, 180.0
"""Level of the brightest pixels (2 %) below which a film is brightened, and the level after it."""
NOISE_BLUR_PX = 1.0
"""Gaussian σ, px, by which the noise of a dark film is smoothed."""
STRIDE = 4
"""The level is taken from every n-th row and column."""


@final
class DarkFilmBrightener:
    """Brightens the frames of a dark film, and leaves those of others as they are."""

    def __init__(self) -> None:
        """No frame was seen."""
        self._brightest = 1.0

    def __call__(
        self, rgb: UInt8[np.ndarray, "height width 3"]
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Brighten the next frame, as much as the brightest one until now allows: some fade in."""
        if self._brightest < DARK_LEVEL:
            level = float(np.percentile(rgb[::STRIDE, ::STRIDE], 98))
            self._brightest = max(self._brightest, level)
        if self._brightest >= DARK_LEVEL:
            return rgb
        smooth = cv2.GaussianBlur(rgb.astype(np.float32), (0, 0), NOISE_BLUR_PX)
        return np.clip(BRIGHT_LEVEL / self._brightest * smooth, 0.0, 255.0).astype(np.uint8)

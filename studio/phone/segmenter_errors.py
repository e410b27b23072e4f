"""Masks as a segmenter gives them: soft wandering borders, halos, holes, missing hands."""

from typing import final

import numpy as np
from jaxtyping import Float, Float32

from studio.input_noise import add_mask_noise, smooth_noise

BORDER_SHARE = 0.0028
"""Standard deviation of the border, as a share of the picture's width: 1.5 of 540 pixels."""
HALO_SHARE = 0.0022
"""Largest growth of the whole mask, as a share of the picture's width."""
SOFT_PX = 2.5
"""Width of the ramp from 0 to 1 at the border."""
HOLE_FRAMES, HAND_GAPS_PER_S = 0.12, 0.35
"""Share of frames with holes; how often a second a hand gets lost."""
HAND_RADIUS_M = 0.11


@final
class SegmenterErrors:
    """What a segmenter does to the exact masks of one video, frame by frame in order."""

    def __init__(self, frames: int, fps: float, seed: int) -> None:
        """Chooses when hands get lost.

        Args:
            frames: Of the video.
            fps: Its frames per second.
            seed: Of all that is random.
        """
        self._generator = np.random.default_rng([seed, 22])
        self._halo = np.tanh(smooth_noise(self._generator, (frames,), over=0.5 * fps))
        self._lost = np.zeros((frames, 2), dtype=bool)
        for _ in range(max(1, round(HAND_GAPS_PER_S * frames / fps))):
            start, side = self._generator.integers(frames), self._generator.integers(2)
            self._lost[start : start + int(self._generator.integers(2, 8)), side] = True

    def apply(
        self,
        alpha: Float32[np.ndarray, "height width"],
        row: int,
        hands_px: Float[np.ndarray, "2 2"],
        px_per_m: float,
    ) -> Float32[np.ndarray, "height width"]:
        """The mask of one frame.

        Args:
            alpha: The exact mask.
            row: Which frame.
            hands_px: Where the left and the right hand are in the picture.
            px_per_m: Pixels per metre at the actor.
        """
        width = alpha.shape[1]
        wrong = add_mask_noise(
            alpha,
            BORDER_SHARE * width,
            self._generator,
            grown_px=HALO_SHARE * width * (0.4 + float(self._halo[row])),
            soft_px=SOFT_PX,
        )
        for side in (0, 1):
            if self._lost[row, side]:
                wrong *= 1.0 - _disc(alpha.shape, hands_px[side], HAND_RADIUS_M * px_per_m)
        inside = np.argwhere(alpha > 0.99)
        if self._generator.random() < HOLE_FRAMES and len(inside):
            for _ in range(int(self._generator.integers(1, 4))):
                row_column = inside[self._generator.integers(len(inside))]
                radius = float(self._generator.uniform(0.01, 0.035)) * px_per_m
                wrong *= 1.0 - _disc(alpha.shape, row_column[::-1].astype(np.float64), radius)
        return wrong.astype(np.float32)


def _disc(
    shape: tuple[int, int], middle_px: Float[np.ndarray, "2"], radius_px: float
) -> Float32[np.ndarray, "height width"]:
    """1 inside a circle, 0 outside, a pixel soft."""
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]] + 0.5
    away = np.hypot(x - middle_px[0], y - middle_px[1])
    return np.clip(radius_px - away + 0.5, 0.0, 1.0).astype(np.float32)

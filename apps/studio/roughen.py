"""Masks as a segmenter gives them: the border wanders in and out."""

import cv2
import numpy as np
from jaxtyping import Float32

BORDER_NOISE_SCALE_PX = 6.0
"""How smooth the wandering is along the border."""


def add_mask_noise(
    alpha: Float32[np.ndarray, "height width"], noise_px: float, generator: np.random.Generator
) -> Float32[np.ndarray, "height width"]:
    """The mask with its border moved in and out by smooth noise of `noise_px` (standard deviation).

    The border stays one pixel soft. Without noise the mask is returned as it is.
    """
    if noise_px == 0.0:
        return alpha
    inside = (alpha >= 0.5).astype(np.uint8)
    away = cv2.distanceTransform(inside, cv2.DIST_L2, 5) - cv2.distanceTransform(
        1 - inside, cv2.DIST_L2, 5
    )
    away -= np.where(inside > 0, 0.5, -0.5)  # from pixel centres to the border between them
    white = generator.standard_normal(alpha.shape).astype(np.float32)
    wander = cv2.GaussianBlur(white, (0, 0), BORDER_NOISE_SCALE_PX, borderType=cv2.BORDER_REFLECT_101)
    wander *= noise_px * 2.0 * np.sqrt(np.pi) * BORDER_NOISE_SCALE_PX  # a blur leaves 1 / (2 √π σ)
    return np.clip(away + wander + 0.5, 0.0, 1.0).astype(np.float32)

"""Outlines and the edges of pictures: distances, directions and slopes."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

EDGE_BLUR_PX = 1.0


def signed_distance_px(mask: Bool[np.ndarray, "height width"]) -> Float32[np.ndarray, "height width"]:
    """How far the middle of each pixel is outside a shape, in pixels; inside negative."""
    hard = mask.astype(np.uint8)
    away = cv2.distanceTransform(1 - hard, cv2.DIST_L2, 5)
    away -= cv2.distanceTransform(hard, cv2.DIST_L2, 5)
    return np.asarray(away + np.where(mask, 0.5, -0.5), dtype=np.float32)


def outward_normals(signed_distance: Float32[np.ndarray, "height width"]) -> Float32[np.ndarray, "height width 2"]:
    """Unit vector (x, y) of each pixel in which the distance from a shape grows.

    Args:
        away: The distance, in any unit.
    """
    sides = [cv2.Sobel(signed_distance, cv2.CV_32F, 1, 0), cv2.Sobel(signed_distance, cv2.CV_32F, 0, 1)]
    slope = np.stack(sides, axis=-1)
    length = np.linalg.norm(slope, axis=-1, keepdims=True) + np.float32(1e-6)
    return np.asarray(slope / length, dtype=np.float32)


def color_gradients(rgb: UInt8[np.ndarray, "height width 3"]) -> Float32[np.ndarray, "height width 3 2"]:
    """Slope of each color to the right and down, by Sobel's filter after a slight blur."""
    smooth = cv2.GaussianBlur(rgb.astype(np.float32), (0, 0), EDGE_BLUR_PX)
    sides = [cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)]
    return np.stack(sides, axis=-1)


def gradient_along(
    rgb: UInt8[np.ndarray, "height width 3"], directions: Float32[np.ndarray, "height width 2"]
) -> Float32[np.ndarray, "height width"]:
    """Largest absolute slope of the three colors along each pixel's direction."""
    sides = color_gradients(rgb)
    along = np.abs(sides[..., 0] * directions[..., :1] + sides[..., 1] * directions[..., 1:])
    # Numpy reduces short axes slowly.
    return np.maximum(np.maximum(along[..., 0], along[..., 1]), along[..., 2])

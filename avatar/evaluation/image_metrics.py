"""Image metrics: PSNR, SSIM and soft IoU, and the plain background they are taken on."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Shaped

from preprocess.observation import Observation

MASK_THRESHOLD = 0.5
"""Alpha above which a pixel belongs to the person."""


def silhouette_of(observation: Observation) -> Bool[np.ndarray, "height width"]:
    """Pixels that show the person."""
    return observation.alpha > MASK_THRESHOLD


def composite_over(
    premultiplied: Float32[np.ndarray, "*shape 4"], background: float
) -> Float32[np.ndarray, "*shape 3"]:
    """Composites a premultiplied image over a gray, from 0 (black) to 1 (white)."""
    return premultiplied[..., :3] + np.float32(background) * (1.0 - premultiplied[..., 3:])


def composite_on_white(
    premultiplied: Float32[np.ndarray, "*shape 4"],
) -> Float32[np.ndarray, "*shape 3"]:
    """Composites a premultiplied image over white."""
    return composite_over(premultiplied, 1.0)


def ground_truth_over(
    observation: Observation, background: float
) -> Float32[np.ndarray, "height width 3"]:
    """Ground truth of a rendering over a gray: alpha · image + (1 - alpha) · background."""
    alpha = observation.alpha[..., None]
    picture = observation.frame.rgb.astype(np.float32) / 255.0
    return alpha * picture + np.float32(background) * (1.0 - alpha)


def ground_truth_on_white(observation: Observation) -> Float32[np.ndarray, "height width 3"]:
    """Ground truth of a rendering on white: alpha · image + (1 - alpha) · white."""
    return ground_truth_over(observation, 1.0)


def psnr(
    image: Float[np.ndarray, "height width 3"],
    truth: Float[np.ndarray, "height width 3"],
    mask: Bool[np.ndarray, "height width"] | None = None,
) -> float:
    """Peak signal-to-noise ratio in dB of images in [0, 1]; infinite if they are equal.

    Args:
        image, truth: Images to compare.
        mask: Pixels that count; all if None. An empty mask gives NaN.
    """
    error = (image.astype(np.float64) - truth) ** 2
    return psnr_of_errors(error if mask is None else error[mask])


def psnr_of_errors(
    errors: Float[np.ndarray, "..."], weights: Float[np.ndarray, "..."] | None = None
) -> float:
    """PSNR in dB of a (weighted) mean of squared errors; NaN of none."""
    if errors.size == 0:
        return float("nan")
    mean = float(np.average(errors, weights=weights))
    return float("inf") if mean == 0.0 else -10.0 * float(np.log10(mean))


def soft_iou(rendered: Shaped[np.ndarray, "*shape"], truth: Shaped[np.ndarray, "*shape"]) -> float:
    """Intersection over union of two silhouettes, in [0, 1]; 1 if both are empty.

    Alphas count by Σ min / Σ max, so that fog lowers the value as well.
    """
    union = float(np.maximum(rendered, truth).sum())
    return float(np.minimum(rendered, truth).sum()) / union if union else 1.0


def ssim(
    image: Float[np.ndarray, "height width 3"], truth: Float[np.ndarray, "height width 3"]
) -> float:
    """Mean structural similarity, in [-1, 1]; NaN of images that are smaller than its window."""
    similarity = ssim_map(image, truth)
    return float(similarity.mean()) if similarity.size else float("nan")


SSIM_BORDER_PX = 5
"""Pixels on each side without a whole window."""


def ssim_map(
    image: Float[np.ndarray, "height width 3"], truth: Float[np.ndarray, "height width 3"]
) -> Float[np.ndarray, "rows columns 3"]:
    """Structural similarity (Wang et al. 2004) by pixel: Gaussian window of 11 taps, σ = 1.5.

    Pixels within `SSIM_BORDER_PX` of the border have none and are left out.
    """
    if min(image.shape[:2]) <= 2 * SSIM_BORDER_PX:
        return np.empty((0, 0, 3))
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    taps /= taps.sum()

    inner = slice(SSIM_BORDER_PX, -SSIM_BORDER_PX)

    def blurred(picture: np.ndarray) -> np.ndarray:
        return np.asarray(cv2.sepFilter2D(picture, cv2.CV_64F, taps, taps))[inner, inner]

    a, b = image.astype(np.float64), truth.astype(np.float64)
    mean_a, mean_b = blurred(a), blurred(b)
    var_a, var_b = blurred(a * a) - mean_a**2, blurred(b * b) - mean_b**2
    both = blurred(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    return ((2 * mean_a * mean_b + c1) * (2 * both + c2)) / (
        (mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2)
    )

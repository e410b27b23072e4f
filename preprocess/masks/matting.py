"""Soft edges for a hard mask: how much of each border pixel is person, by the colours around it.

How much of each border pixel is person, where it is known what lies behind.

A pixel of the border shows I = a F + (1 - a) B (Chuang et al. 2001, a Bayesian approach to digital
matting, with a background that is known). The border may lie elsewhere than the mask says: each
displacement gives the pixel an a, and is as likely as the mask's usual error is so large and as
the colours agree with it. The answer is the mean over all displacements.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from preprocess.body.silhouette import signed_distance_px

LOCAL_COLOR_PX = 1.0
"""From how far around a border pixel the colours of person and background come (a Gaussian's σ)."""

EDGE_SIGMA_PX = 0.5
"""How wide the edge of a picture is: the σ of the lens and the pixel."""

COLOR_CONTRAST = 20.0, 45.0
"""Colors less far apart than the first tell nothing; there the mask is only smoothed. From the
second on they tell all they can."""

MAX_COLOR_WEIGHT = 0.5
"""How far colours are believed against the smoothed mask: thin stripes and hair deceive them."""

CROP_MARGIN_PX = 8
"""So far around the person pixels are looked at."""

MIXTURE_RESIDUAL = 30.0
"""A pixel whose colour is this far from all mixtures of both is believed half as much."""


def soften_border(
    rgb: UInt8[np.ndarray, "height width 3"], mask: Bool[np.ndarray, "height width"]
) -> Float32[np.ndarray, "height width"]:
    """The mask with the pixels along its border split between person and background.

    A pixel of the border is a mixture I = a F + (1 - a) B of the mean colours of person and
    background beside it, so a is the projection of I - B on F - B. It is averaged with the mask
    seen through a lens, and counts less where F and B are alike or I is no mixture of them.
    """
    hard = mask.astype(np.uint8)
    left, top, width, height = cv2.boundingRect(hard)
    around = np.s_[max(top - CROP_MARGIN_PX, 0) : top + height + CROP_MARGIN_PX,
                   max(left - CROP_MARGIN_PX, 0) : left + width + CROP_MARGIN_PX]  # fmt: skip
    alpha = hard.astype(np.float32)
    alpha[around] = _soften_crop(rgb[around], np.ascontiguousarray(hard[around]))
    return alpha


def _soften_crop(
    rgb: UInt8[np.ndarray, "height width 3"], hard: UInt8[np.ndarray, "height width"]
) -> Float32[np.ndarray, "height width"]:
    square = np.ones((3, 3), np.uint8)
    inside, touched = cv2.erode(hard, square), cv2.dilate(hard, square)
    border = (touched > 0) & (inside == 0)
    smooth = cv2.GaussianBlur(hard.astype(np.float32), (0, 0), EDGE_SIGMA_PX)
    picture = rgb.astype(np.float32)
    front, has_front = _local_mean_color(picture, inside)
    back, has_back = _local_mean_color(picture, 1 - touched)
    apart = front - back
    squared = (apart**2).sum(axis=-1)
    share = ((picture - back) * apart).sum(axis=-1) / np.maximum(squared, np.float32(1.0))
    beside = np.abs(picture - back - share[..., None] * apart).max(axis=-1)
    low, high = COLOR_CONTRAST[0] ** 2, COLOR_CONTRAST[1] ** 2
    trust = MAX_COLOR_WEIGHT * np.clip((squared - low) / (high - low), 0.0, 1.0)
    trust *= np.clip(1.5 - beside / MIXTURE_RESIDUAL, 0.0, 1.0) * (has_front & has_back)
    alpha = trust * np.clip(share, 0.0, 1.0) + (1.0 - trust) * smooth
    return np.where(border, alpha, hard).astype(np.float32)


def _local_mean_color(
    picture: Float32[np.ndarray, "height width 3"], selected: UInt8[np.ndarray, "height width"]
) -> tuple[Float32[np.ndarray, "height width 3"], Bool[np.ndarray, "height width"]]:
    """Mean colour of the chosen pixels around each pixel, and whether there are any."""
    chosen = selected.astype(np.float32)
    weight = cv2.GaussianBlur(chosen, (0, 0), LOCAL_COLOR_PX)
    total = cv2.GaussianBlur(picture * chosen[..., None], (0, 0), LOCAL_COLOR_PX)
    return total / np.maximum(weight, np.float32(1e-6))[..., None], weight > 1e-4


BORDER_SIGMA_PX = 0.35
"""How far borders of masks are off (the standard deviation)."""
BORDER_SHIFTS_PX = np.arange(-1.6, 1.61, 0.2, dtype=np.float32)
"""The displacements that are tried."""
BORDER_BAND_PX = 2.2
"""So far from the mask's border pixels are looked at."""

OUTLIER_PROBABILITY, OUTLIER_SPREAD = 0.2, 50.0
"""The person may look otherwise than expected: so likely, and then by so much."""
LIKELIHOOD_FLOOR = 1e-4
"""How likely it is that nothing of all this is true, against a colour that agrees wholly."""
LIKELIHOOD_EXPONENT = 0.6
"""The colours' share in the likelihood: beside each other pixels err alike."""


def refine_border(
    rgb: UInt8[np.ndarray, "height width 3"],
    alpha: Float32[np.ndarray, "height width"],
    background: tuple[Float32[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]],
    foreground: tuple[Float32[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]],
) -> Float32[np.ndarray, "height width"]:
    """A mask with its border where colours say that it is.

    Args:
        rgb: The picture.
        alpha: The mask.
        behind: What lies behind each pixel, and the standard deviation of that, in levels.
        person: What the person looks like in each pixel, likewise. Where one of both deviations is
            infinite the mask stays.
    """
    outside = border_distance_px(alpha)
    spread = background[1] + foreground[1]
    at = (np.abs(outside) < BORDER_BAND_PX) & np.isfinite(spread)
    away = outside[at]
    tried = np.clip(0.5 - (away[:, None] + BORDER_SHIFTS_PX), 0.0, 1.0).astype(np.float32)
    off, apart = (
        rgb[at].astype(np.float32) - background[0][at],
        foreground[0][at] - background[0][at],
    )
    squared = (off**2).sum(axis=1)[:, None] - 2.0 * tried * (off * apart).sum(axis=1)[:, None]
    squared += tried**2 * (apart**2).sum(axis=1)[:, None]
    noise = (background[1][at] ** 2)[:, None] * (1.0 - tried) ** 2 + 1.0
    likely = LIKELIHOOD_FLOOR + (1.0 - OUTLIER_PROBABILITY) * _color_likelihood(
        squared, noise, tried, foreground[1][at][:, None]
    )
    likely += OUTLIER_PROBABILITY * _color_likelihood(
        squared, noise, tried, np.float32(OUTLIER_SPREAD)
    )
    weight = likely**LIKELIHOOD_EXPONENT * np.exp(-0.5 * (BORDER_SHIFTS_PX / BORDER_SIGMA_PX) ** 2)
    found = alpha.copy()
    found[at] = (weight * tried).sum(axis=1) / weight.sum(axis=1)
    return found


def _color_likelihood(
    squared: Float32[np.ndarray, "pixels tried"],
    noise: Float32[np.ndarray, "pixels tried"],
    alpha: Float32[np.ndarray, "pixels tried"],
    spread: Float32[np.ndarray, "..."] | np.float32,
) -> Float32[np.ndarray, "pixels tried"]:
    """Density of a colour so far from the mixture, up to a factor."""
    variance = noise + (alpha * spread) ** 2
    return np.exp(-0.5 * squared / variance) * (np.float32(16.0) / variance) ** np.float32(1.5)


def border_distance_px(
    alpha: Float32[np.ndarray, "height width"],
) -> Float32[np.ndarray, "height width"]:
    """How far the middle of each pixel is outside the mask's border, to a part of a pixel."""
    steps = signed_distance_px(alpha > 0.5)
    mixed = (np.abs(alpha - 0.5) < 0.47) & (np.abs(steps) < 1.2)
    return np.where(mixed, 0.5 - alpha, steps).astype(np.float32)

"""How much of each border pixel is person, where it is known what lies behind.

A pixel of the border shows I = a F + (1 - a) B (Chuang et al. 2001, a Bayesian approach to digital
matting, with a background that is known). The border may lie elsewhere than the mask says: each
displacement gives the pixel an a, and is as likely as the mask's usual error is so large and as
the colours agree with it. The answer is the mean over all displacements.
"""

import numpy as np
from jaxtyping import Float32, UInt8

from preprocess.masks.outline import signed_distance_px

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
    off, apart = rgb[at].astype(np.float32) - background[0][at], foreground[0][at] - background[0][at]
    squared = (off**2).sum(axis=1)[:, None] - 2.0 * tried * (off * apart).sum(axis=1)[:, None]
    squared += tried**2 * (apart**2).sum(axis=1)[:, None]
    noise = (background[1][at] ** 2)[:, None] * (1.0 - tried) ** 2 + 1.0
    likely = LIKELIHOOD_FLOOR + (1.0 - OUTLIER_PROBABILITY) * _color_likelihood(squared, noise, tried, foreground[1][at][:, None])
    likely += OUTLIER_PROBABILITY * _color_likelihood(squared, noise, tried, np.float32(OUTLIER_SPREAD))
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


def border_distance_px(alpha: Float32[np.ndarray, "height width"]) -> Float32[np.ndarray, "height width"]:
    """How far the middle of each pixel is outside the mask's border, to a part of a pixel."""
    steps = signed_distance_px(alpha > 0.5)
    mixed = (np.abs(alpha - 0.5) < 0.47) & (np.abs(steps) < 1.2)
    return np.where(mixed, 0.5 - alpha, steps).astype(np.float32)

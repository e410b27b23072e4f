"""The guided filter with a color guide (He et al. 2013, Guided image filtering)."""

import cv2
import numpy as np
from jaxtyping import Float32

STRIP_PX = 24_000
"""Pixels of the strips that are processed at once: planes that stay in the cache are twice as
fast."""


def guided_coefficients(
    guide: Float32[np.ndarray, "3 height width"],
    alpha: Float32[np.ndarray, "height width"],
    radius_px: int,
    tolerance: float,
) -> Float32[np.ndarray, "4 height width"]:
    """Fit alpha = a · color + b in the window around each pixel, and average a and b over windows.

    The averages may be enlarged and applied to a larger image: that is the fast guided filter (He
    and Sun 2015, arXiv:1505.00996).

    Args:
        guide: The image's three channels, in levels.
        alpha: What to fit.
        radius_px: Half the window's edge, px; the edge is `2 * radius_px + 1`.
        tolerance: Standard deviation of colors, in levels, below which a window counts as one.

    Returns:
        a of the three channels, and b.
    """
    height, width = alpha.shape
    rows, halo = max(STRIP_PX // width, 4 * radius_px), 2 * radius_px
    found = np.empty((4, height, width), np.float32)
    for top in range(0, height, rows):
        first, end = max(top - halo, 0), min(top + rows + halo, height)
        part = _fit_windows(guide[:, first:end], alpha[first:end], radius_px, tolerance)
        found[:, top : top + rows] = part[:, top - first : top - first + rows]
    return found


def _fit_windows(
    guide: Float32[np.ndarray, "3 rows width"],
    alpha: Float32[np.ndarray, "rows width"],
    radius_px: int,
    tolerance: float,
) -> Float32[np.ndarray, "4 rows width"]:
    window = (2 * radius_px + 1, 2 * radius_px + 1)
    each = (*guide, alpha)
    mean = [cv2.blur(plane, window) for plane in each]

    def covariance(i: int, j: int) -> Float32[np.ndarray, "rows width"]:
        product = cv2.blur(cv2.multiply(each[i], each[j]), window)
        product -= cv2.multiply(mean[i], mean[j])
        return product

    rr, gg, bb = (covariance(i, i) + np.float32(tolerance**2) for i in range(3))
    rg, rb, gb = covariance(0, 1), covariance(0, 2), covariance(1, 2)
    red, green, blue = (covariance(i, 3) for i in range(3))  # become the slopes a
    # Gauss's elimination of the symmetric system, in place.
    factor = rg / rr
    gg -= factor * rg
    gb -= factor * rb
    green -= factor * red
    other = rb / rr
    bb -= other * rb
    blue -= other * red
    last = gb / gg
    bb -= last * gb
    blue -= last * green
    blue /= bb
    green /= gg
    green -= last * blue
    red /= rr
    red -= factor * green
    red -= other * blue
    offset = mean[3]
    for slope, average in zip((red, green, blue), mean, strict=False):
        offset -= slope * average
    return np.stack([cv2.blur(plane, window) for plane in (red, green, blue, offset)])


def apply_coefficients(
    guide: Float32[np.ndarray, "3 height width"],
    coefficients: Float32[np.ndarray, "4 height width"],
) -> Float32[np.ndarray, "height width"]:
    """a · color + b at each pixel."""
    found = coefficients[3].copy()
    for color, slope in zip(guide, coefficients, strict=False):
        found += cv2.multiply(color, slope)
    return found

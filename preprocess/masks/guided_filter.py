"""The guided filter with a color guide (He et al. 2013, Guided image filtering)."""

import cv2
import numpy as np
from jaxtyping import Float32


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
    window = (2 * radius_px + 1, 2 * radius_px + 1)
    each = (*guide, alpha)
    mean = [cv2.blur(plane, window) for plane in each]

    def covariance(i: int, j: int) -> Float32[np.ndarray, "height width"]:
        product = cv2.blur(cv2.multiply(each[i], each[j]), window)
        return cv2.subtract(product, cv2.multiply(mean[i], mean[j]))

    squared = np.float32(tolerance**2)
    rr, gg, bb = (covariance(i, i) + squared for i in range(3))
    rg, rb, gb = covariance(0, 1), covariance(0, 2), covariance(1, 2)
    ra, ga, ba = (covariance(i, 3) for i in range(3))
    # The symmetric 3 x 3 system by its adjugate.
    irr, irg, irb = gg * bb - gb * gb, gb * rb - rg * bb, rg * gb - gg * rb
    igg, igb, ibb = rr * bb - rb * rb, rb * rg - rr * gb, rr * gg - rg * rg
    inverse = np.float32(1.0) / (irr * rr + irg * rg + irb * rb)
    slopes = (
        (irr * ra + irg * ga + irb * ba) * inverse,
        (irg * ra + igg * ga + igb * ba) * inverse,
        (irb * ra + igb * ga + ibb * ba) * inverse,
    )
    offset = mean[3] - slopes[0] * mean[0] - slopes[1] * mean[1] - slopes[2] * mean[2]
    return np.stack([cv2.blur(plane, window) for plane in (*slopes, offset)])


def apply_coefficients(
    guide: Float32[np.ndarray, "3 height width"],
    coefficients: Float32[np.ndarray, "4 height width"],
) -> Float32[np.ndarray, "height width"]:
    """a · color + b at each pixel."""
    found = coefficients[3].copy()
    for color, slope in zip(guide, coefficients, strict=False):
        found += cv2.multiply(color, slope)
    return found

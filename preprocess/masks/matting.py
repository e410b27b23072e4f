"""Alpha matting of a mask's border before a known background, and the guided filter.

A border pixel shows I = a F + (1 - a) B (Chuang et al. 2001, a Bayesian approach to digital
matting). `refine_border` knows the background: the border may be displaced from the mask's, and
sharp or soft. Each displacement and width gives a pixel its a, and is weighted by the prior of the
mask's error, by how often borders are so wide in the frame, and by the likelihood of the color. The
result is the mean over all of them. `guided_coefficients` are those of the guided filter with a
color guide (He et al. 2013, Guided image filtering).
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Shaped

from preprocess.body.body_surface import signed_distance_px
from preprocess.masks.color_models import (
    Channels,
    FullImage,
    FullPlane,
    Pixels,
    Plane,
    PlateColors,
)

BORDER_WIDTHS_PX = np.array([1.0, 2.0, 4.0], np.float32)
"""Widths over which alpha falls from 1 to 0: borders are soft where a picture was enlarged, is out
of focus or moves. How often each occurs is estimated in each frame."""
BORDER_SHIFTS_PX = np.linspace(-1.6, 1.6, 9, dtype=np.float32)
"""Displacements of a sharp border that are averaged, px; they grow alike."""
BORDER_BAND_PX = 3.6
"""Largest distance from the mask's border of a pixel that is refined, px."""
COLOR_AXES = np.array(
    [[0.45, 0.35, -0.118], [0.88, -0.293, -0.232], [0.171, -0.057, 0.35]], np.float32
)
"""Brightness, red and blue of a color, as columns. The last two count less: videos store them at
half the resolution, so at a border they are the neighbors' too."""
OUTLIER_PROBABILITY = 0.2
"""Probability of a foreground color that the appearance model does not predict."""

COLOR_MARGIN_PX = 4
"""Width of the background about the person whose colors are averaged, px."""


def person_colors(
    rgb: Shaped[np.ndarray, "height width 3"], alpha: Plane
) -> Float32[np.ndarray, "height width 3"]:
    """The person's own color of each pixel, in levels: a border pixel shows the background, too.

    Person's and background's colors are averaged nearby, weighted by alpha, and the person's is
    moved to where both mix to what the image shows (Forte, ICIP 2021). Where alpha is 1
    it is the image's, where alpha is 0 it means nothing.
    """
    found = rgb.astype(np.float32)
    left, top, width, height = cv2.boundingRect((alpha > 0.0).astype(np.uint8))
    top, left = max(top - COLOR_MARGIN_PX, 0), max(left - COLOR_MARGIN_PX, 0)
    bottom, right = top + height + 2 * COLOR_MARGIN_PX, left + width + 2 * COLOR_MARGIN_PX
    part = np.s_[top:bottom, left:right]
    image, opacity = found[part], alpha[part]
    half_px = (image.shape[1] + 1) // 2, (image.shape[0] + 1) // 2
    window = 3, 3
    share, person, both = (
        cv2.blur(cv2.resize(each, half_px, interpolation=cv2.INTER_AREA), window)
        for each in (opacity, image * opacity[..., None], image)
    )
    rows, columns = np.nonzero((opacity > 0.0) & (opacity < 1.0))
    there = rows // 2, columns // 2
    mixed, shown = opacity[rows, columns][:, None], image[rows, columns]
    mean = share[there][:, None]
    near = person[there] / np.maximum(mean, 1e-3)
    far = (both[there] - person[there]) / np.maximum(1.0 - mean, 1e-3)
    near += mixed * (shown - mixed * near - (1.0 - mixed) * far)
    image[rows, columns] = np.clip(near, 0.0, 255.0)
    return found


def refine_border(
    rgb: Shaped[np.ndarray, "height width 3"],
    alpha: Plane,
    background: tuple[Float32[np.ndarray, "height width 3"], Plane],
    foreground: tuple[Float32[np.ndarray, "height width 3"], Plane],
) -> Plane:
    """Move a mask's border to where the colors change from person to background, as softly.

    Of background and person the expected color of each pixel and its standard deviation are given,
    in levels; where either deviation is infinite the mask stays.
    """
    outside = border_distance_px(alpha)
    spread = background[1] + foreground[1]
    at = (np.abs(outside) < BORDER_BAND_PX) & np.isfinite(spread)
    found = alpha.copy()
    if not at.any():
        return found
    pixels = _BorderPixels(
        away=outside[at],
        off=(rgb[at].astype(np.float32) - background[0][at]) @ COLOR_AXES,
        apart=(foreground[0][at] - background[0][at]) @ COLOR_AXES,
        noise=background[1][at] ** 2,
        spread=foreground[1][at],
    )
    shares = _width_shares(pixels)
    likely = shares > 0.05
    tried, weight = _weigh_borders(pixels, BORDER_WIDTHS_PX[likely])
    weight *= shares[likely, None]
    found[at] = (weight * tried).sum(axis=(1, 2)) / weight.sum(axis=(1, 2))
    return found


class _BorderPixels(NamedTuple):
    """Pixels near a mask's border.

    Attributes:
        away: Distance from the border, positive outside, px.
        off, apart: The pixel's color and the person's, from the background's, by `COLOR_AXES`.
        noise, spread: Variance of the background's color, standard deviation of the person's.
    """

    away: Pixels
    off: Float32[np.ndarray, "pixels 3"]
    apart: Float32[np.ndarray, "pixels 3"]
    noise: Pixels
    spread: Pixels

    def every(self, stride: int) -> "_BorderPixels":
        """One of `stride` pixels."""
        return _BorderPixels(*(each[::stride] for each in self))


def _weigh_borders(
    pixels: _BorderPixels, widths_px: Float32[np.ndarray, "widths"]
) -> tuple[
    Float32[np.ndarray, "pixels widths shifts"], Float32[np.ndarray, "pixels widths shifts"]
]:
    """Alpha of each pixel for each width and displacement of the border, and its weight."""
    wide = widths_px[:, None]
    across = pixels.away[:, None, None] / wide + BORDER_SHIFTS_PX / np.sqrt(wide)
    tried = np.clip(0.5 - across, 0.0, 1.0)
    off, apart, noise, spread = (each[:, None, None] for each in pixels[1:])
    # |I - (a F + (1 - a) B)|² = |off - a apart|², for each displacement's a
    squared = (off**2).sum(axis=-1) - 2.0 * tried * (off * apart).sum(axis=-1)
    squared += tried**2 * (apart**2).sum(axis=-1)
    noisy = noise * (1.0 - tried) ** 2 + 1.0
    likely = 1e-4 + (1.0 - OUTLIER_PROBABILITY) * _color_likelihood(squared, noisy, tried, spread)
    likely += OUTLIER_PROBABILITY * _color_likelihood(squared, noisy, tried, 50.0)
    weight = 0.6 * np.log(likely)  # errors of neighboring pixels are correlated
    # a sharp border is off by 0.35 px (σ); shift and σ grow with the root of its width
    weight -= 0.5 * (BORDER_SHIFTS_PX / 0.35) ** 2
    return tried, np.exp(weight, out=weight)


def _width_shares(pixels: _BorderPixels) -> Float32[np.ndarray, "widths"]:
    """How often each width occurs, by the likelihoods of all pixels (expectation maximization).

    Borders are sharp as far as colors inside them are not the person's expected ones: half of an
    expected color would be a soft border everywhere.
    """
    inside = pixels.away < 1.0 - BORDER_BAND_PX
    off = np.linalg.norm(pixels.off[inside] - pixels.apart[inside], axis=1)
    expected = np.float32((off < 2.0 * pixels.spread[inside]).sum() / max(inside.sum(), 1))
    likelihoods = _weigh_borders(pixels.every(4), BORDER_WIDTHS_PX)[1].sum(axis=2)
    shares = BORDER_WIDTHS_PX**-2 / (BORDER_WIDTHS_PX**-2).sum()  # mostly sharp, if all are alike
    for _ in range(8):
        belongs = likelihoods * shares
        shares = (belongs / belongs.sum(axis=1, keepdims=True)).mean(axis=0)
    shares *= expected
    shares[0] += 1.0 - expected
    return shares


def _color_likelihood(
    squared: Float32[np.ndarray, "*tried"],
    noise: Float32[np.ndarray, "*tried"],
    alpha: Float32[np.ndarray, "*tried"],
    spread: Float32[np.ndarray, "..."] | float,
) -> Float32[np.ndarray, "*tried"]:
    """Density of a color at a squared distance from the mixture, up to a factor."""
    variance = noise + (alpha * spread) ** 2
    ratio = 16.0 / variance
    return np.exp(-0.5 * squared / variance) * ratio * np.sqrt(ratio)


def border_distance_px(alpha: Plane) -> Plane:
    """Sub-pixel distance of each pixel's center from the mask's border, positive outside, px."""
    steps = signed_distance_px(alpha > 0.5)
    mixed = (np.abs(alpha - 0.5) < 0.47) & (np.abs(steps) < 1.2)
    return np.where(mixed, 0.5 - alpha, steps).astype(np.float32)


def guided_coefficients(
    guide: Channels, alpha: Plane, radius_px: int, tolerance: float
) -> Float32[np.ndarray, "4 height width"]:
    """Fit alpha = a · color + b in the window around each pixel, and average (a, b) over windows.

    The averages may be enlarged and applied to a larger image: that is the fast guided filter (He
    and Sun 2015, arXiv:1505.00996).

    A window's edge is `2 * radius_px + 1`; the tolerance is the standard deviation of colors, in
    levels, below which it counts as one.
    """
    height, width = alpha.shape
    # strips whose planes stay in the cache are twice as fast
    rows, halo = max(24_000 // width, 4 * radius_px), 2 * radius_px
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

    # a = (Σ + tolerance² 1)⁻¹ cov(color, alpha), and b = mean(alpha) - a · mean(color)
    rr, gg, bb = (covariance(i, i) + tolerance**2 for i in range(3))
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
    guide: Channels, coefficients: Float32[np.ndarray, "4 height width"]
) -> Plane:
    """a · color + b at each pixel."""
    found = coefficients[3].copy()
    for color, slope in zip(guide, coefficients, strict=False):
        found += cv2.multiply(color, slope)
    return found


def steepen(alpha: Plane) -> Plane:
    """Steepen a mask around 1/2."""
    return np.clip(2.0 * alpha - 0.5, 0.0, 1.0)


def move_border(image: Channels, alpha: Plane, plate: PlateColors) -> Plane:
    """Change of alpha near a mask's border, by colors between the person's and the background's."""
    sure = cv2.erode((alpha > 0.8).astype(np.uint8), np.ones((3, 3), np.uint8))
    size_px, window = alpha.shape[::-1], (3, 3)
    half_px = (size_px[0] + 1) // 2, (size_px[1] + 1) // 2
    weight, *planes = (
        cv2.resize(each, half_px, interpolation=cv2.INTER_AREA)
        for each in (sure.astype(np.float32), *image)
    )
    inverse = 1.0 / np.maximum(cv2.blur(weight, window), 1e-6)
    front = [cv2.blur(plane * weight, window) * inverse for plane in planes]
    total = planes[0] ** 2 + planes[1] ** 2 + planes[2] ** 2
    spread = cv2.blur(total * weight, window) * inverse
    spread -= front[0] ** 2 + front[1] ** 2 + front[2] ** 2
    # colors that the window's mean misses deviate by 14 levels
    spread = np.sqrt(np.maximum(spread, 0.0) / 3.0 + 14.0**2)
    spread[inverse > 1e5] = np.inf
    person = cv2.resize(cv2.merge(front), size_px)
    behind = np.where(plate.known, np.sqrt(plate.variance), np.inf)
    colors, before = (np.moveaxis(each, 0, 2) for each in (image, plate.mean))
    known = cv2.resize(spread.astype(np.float32), size_px, interpolation=cv2.INTER_NEAREST)
    return refine_border(colors, alpha, (before, behind), (person, known)) - alpha


def enlarge_alpha(
    rgb: FullImage, coefficients: Float32[np.ndarray, "4 height width"], times: int, moved: Plane
) -> FullPlane:
    """The mask at full size: the filter's coefficients, enlarged and applied, and moved."""
    size_px = rgb.shape[1], rgb.shape[0]

    def full(plane: Plane) -> FullPlane:
        return plane if times == 1 else cv2.resize(plane, size_px)

    alpha = full(coefficients[3])
    for channel, slope in zip(cv2.split(np.ascontiguousarray(rgb)), coefficients, strict=False):
        alpha = alpha + cv2.multiply(channel, full(slope), dtype=cv2.CV_32F)
    return np.clip(steepen(alpha) + full(moved), 0.0, 1.0)

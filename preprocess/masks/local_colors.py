"""How likely colors are near a pixel, on the person and beside it.

A striped shirt has several colors, none of which is their mean. So the sure pixels of a frame are
sorted into a few colors (k-means), each with a spread; near a pixel the person's colors are these,
mixed as often as they are found on the person around it, and the same for the background.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int

COLORS = 5
"""Colors of the person, and as many of the background."""
ROUNDS = 2
"""Rounds of k-means."""
REDUCTION = 3
"""Reduction of the image from which colors are learnt."""
COLOR_SPREAD = 9.0
"""Standard deviation, in levels, that is added to each color's own."""
ANYWHERE = 0.1
"""Weight of the colors of the whole person, or background, beside those nearby."""
UNSEEN = 0.02
"""Density of a color that neither has, relative to `REFERENCE_SPREAD`."""
REFERENCE_SPREAD = 16.0
"""Standard deviation, in levels, at whose peak a density is 1."""

ONE = np.float32(1.0)
PixelMask = Bool[np.ndarray, "height width"]
Pixels = Float32[np.ndarray, "pixels"]
Numbers = Int[np.ndarray, "pixels"]


def color_density(
    squared: Float32[np.ndarray, "*pixels"], variance: Float32[np.ndarray, "*pixels"]
) -> Float32[np.ndarray, "*pixels"]:
    """Density of a color at a squared distance from its mean, relative to the reference peak."""
    ratio = np.float32(REFERENCE_SPREAD**2) / variance
    return np.exp(np.float32(-0.5) * squared / variance) * ratio * np.sqrt(ratio)


def local_densities(
    image: Float32[np.ndarray, "3 height width"],
    sure: tuple[PixelMask, PixelMask],
    at: tuple[Numbers, Numbers],
    sigma_px: float,
) -> tuple[Pixels, Pixels]:
    """Density of pixels' colors among the sure colors of person and of background near each.

    Args:
        image: The channels, in levels.
        sure: Pixels that are surely person, and surely background.
        at: Rows and columns of the pixels.
        sigma_px: Gaussian σ of the neighborhood, px.
    """
    height, width = image.shape[1:]
    small_px = -(-width // REDUCTION), -(-height // REDUCTION)
    small = cv2.merge([cv2.resize(each, small_px, interpolation=cv2.INTER_AREA) for each in image])
    chosen = [
        cv2.resize(each.astype(np.float32), small_px, interpolation=cv2.INTER_AREA) > 0.99
        for each in sure
    ]
    means, variance, labels = _sort_colors(small, (chosen[0], chosen[1]))
    cells = at[0] // REDUCTION * small_px[0] + at[1] // REDUCTION
    used = np.flatnonzero(np.bincount(cells))
    place = np.zeros(small_px[0] * small_px[1], np.int32)
    place[used] = np.arange(len(used))
    place = place[cells]
    likely = _squared_distances(image[:, at[0], at[1]], means, np.float32(-0.5) / variance)
    np.exp(likely, out=likely)
    peaks = (np.float32(REFERENCE_SPREAD**2) / variance) ** np.float32(1.5)
    each_color = np.eye(len(means), dtype=np.float32)

    def density(where: PixelMask) -> Pixels:
        found = each_color[labels] * where[..., None]
        overall = np.ones(labels.size, np.float32) @ found.reshape(labels.size, -1)
        overall += np.float32(1e-6)
        overall /= overall.sum()
        near = cv2.GaussianBlur(found, (0, 0), sigma_px / REDUCTION).reshape(labels.size, -1)[used]
        near += np.float32(1e-6) * overall  # nothing of it is near: any of it
        near *= np.float32(1.0 - ANYWHERE) / (near @ np.ones((len(means), 1), np.float32))
        near += np.float32(ANYWHERE) * overall
        return np.einsum("pc,pc->p", (near * peaks)[place], likely) + np.float32(UNSEEN)

    return density(chosen[0]), density(chosen[1])


def _sort_colors(
    image: Float32[np.ndarray, "height width 3"], sure: tuple[PixelMask, PixelMask]
) -> tuple[
    Float32[np.ndarray, "colors 3"],
    Float32[np.ndarray, "colors"],
    Int[np.ndarray, "height width"],
]:
    """Means and variances of a few colors, and the number of each pixel's."""
    taught = image[sure[0] | sure[1]].T
    means = np.concatenate([_frequent_colors(image[each].T) for each in sure])
    if not len(means):
        means = np.zeros((1, 3), np.float32)
    for _ in range(ROUNDS if taught.size else 0):
        nearest = _squared_distances(taught, means).argmin(axis=1)
        means = _mean_colors(taught, nearest, len(means))
    away = _squared_distances(taught, means)
    nearest = away.argmin(axis=1)
    counts = np.maximum(np.bincount(nearest, minlength=len(means)), 1)
    variance = np.bincount(nearest, away.min(axis=1), minlength=len(means)) / (3.0 * counts)
    everywhere = _squared_distances(image.reshape(-1, 3).T, means).argmin(axis=1)
    return (
        means,
        (variance + COLOR_SPREAD**2).astype(np.float32),
        everywhere.reshape(image.shape[:2]),
    )


def _frequent_colors(colors: Float32[np.ndarray, "3 pixels"]) -> Float32[np.ndarray, "colors 3"]:
    """Means of the fullest of 8 x 8 x 8 bins."""
    red, green, blue = colors.astype(np.int64) >> 5
    bins = (red << 6) | (green << 3) | blue
    fullest = np.argsort(-np.bincount(bins, minlength=512), kind="stable")[:COLORS]
    places = np.full(512, COLORS)
    places[fullest] = np.arange(COLORS)
    return _mean_colors(colors, places[bins], COLORS)


def _mean_colors(
    colors: Float32[np.ndarray, "3 pixels"], numbers: Numbers, count: int
) -> Float32[np.ndarray, "colors 3"]:
    """Mean of the colors of each number below a count that has any."""
    many = np.bincount(numbers, minlength=count)[:count]
    sums = [np.bincount(numbers, each, minlength=count)[:count][many > 0] for each in colors]
    return (np.stack(sums, axis=1) / many[many > 0, None]).astype(np.float32)


def _squared_distances(
    colors: Float32[np.ndarray, "3 pixels"],
    means: Float32[np.ndarray, "colors 3"],
    scale: Float32[np.ndarray, "*colors"] | np.float32 = ONE,
) -> Float32[np.ndarray, "pixels colors"]:
    """Squared distance of each color from each mean, times a factor of each mean."""
    red, green, blue = colors
    squared = red * red + green * green + blue * blue
    terms = np.stack([red, green, blue, squared, np.ones_like(red)])
    factors = [
        *(np.float32(-2.0) * means.T),
        np.ones(len(means), np.float32),
        (means**2).sum(axis=1),
    ]
    return terms.T @ (np.stack(factors) * scale)

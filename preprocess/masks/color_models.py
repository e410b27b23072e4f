"""The colors of a static background, and the brightening of dark films.

A static camera sees the same behind the person again and again: a plate keeps a running mean and
variance of every pixel's color. A phone's exposure and white balance drift, so each frame is
compared after one gain per channel. If too much of the background differs nevertheless, the camera
has moved: the plate starts again.
"""

from typing import NamedTuple, final

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from capture.source import RgbImage

Plane = Float32[np.ndarray, "height width"]
Channels = Float32[np.ndarray, "3 height width"]
PixelMask = Bool[np.ndarray, "height width"]
Pixels = Float32[np.ndarray, "pixels"]
FullImage = UInt8[np.ndarray, "rows columns 3"]
FullPlane = Float32[np.ndarray, "rows columns"]
"""Planes and channels of a working image, some of its pixels, and a frame of full size."""
SHADOW_GAIN = 0.6, 1.05
"""Range of the factors by which the person's shadow and reflected light change the background."""
MIN_SEEN_FRAMES = 2.0
"""Frames in which a pixel must have been background before its color is known."""


DARK_LEVEL, BRIGHT_LEVEL = 80.0, 180.0
"""Level of the brightest pixels (2 %) below which a film is brightened, and the level after it."""


def color_density(
    squared: Float32[np.ndarray, "*pixels"], variance: Float32[np.ndarray, "*pixels"]
) -> Float32[np.ndarray, "*pixels"]:
    """Density of a color at a squared distance from its mean; 1 at the peak of σ = 16 levels."""
    ratio = 256.0 / variance
    return np.exp(-0.5 * squared / variance) * ratio * np.sqrt(ratio)


class PlateColors(NamedTuple):
    """The background in a part of a frame, at the frame's exposure.

    `mean` holds the colors of the `known` pixels, in levels; `variance` is that of one channel.
    """

    known: PixelMask
    mean: Channels
    variance: Plane

    def in_sight(self, image: Channels) -> PixelMask:
        """Pixels that show the background's texture: no person is before them.

        A flat background of a sleeve's color says little, leaves and books say nearly everything.
        """
        window = 7, 7  # px
        weight = self.known.astype(np.float32)
        share = cv2.blur(weight, window)
        off, texture, squared = (np.zeros_like(weight) for _ in range(3))
        for seen, mean in zip(image, self.mean, strict=True):
            expected = mean * weight
            off += (seen - mean) ** 2
            squared += expected * mean
            texture -= cv2.blur(expected, window) ** 2
        off = cv2.blur(off * weight, window)
        texture /= np.maximum(share, 0.01)
        texture += cv2.blur(squared, window)
        textured = texture > 3.0 * 7.0**2 * share  # a deviation of 7 levels a channel
        alike = off < 0.2 * texture
        return self.known & (share > 0.7) & textured & alike


def plate_density(
    colors: Float32[np.ndarray, "3 pixels"], mean: Float32[np.ndarray, "3 pixels"], variance: Pixels
) -> Pixels:
    """Density of colors where the background is known, as it is or in the person's shadow.

    A shadow has the background's color, only darker (Horprasert et al. 1999, a statistical approach
    for background subtraction and shadow detection).
    """
    # least squares: gain = color · mean / |mean|²
    dot = colors[0] * mean[0] + colors[1] * mean[1] + colors[2] * mean[2]
    length = np.maximum(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2, 1.0)
    gain = np.clip(dot / length, SHADOW_GAIN[0], SHADOW_GAIN[1])
    plain, shaded = np.zeros((2, len(dot)), np.float32)
    for color, expected in zip(colors, mean, strict=True):
        plain += (color - expected) ** 2
        shaded += (color - gain * expected) ** 2
    return (
        0.9 * color_density(plain, variance)
        + 0.1 * color_density(shaded, variance)  # shaded or lit by the person
        + 0.00025
    )


@final
class BackgroundPlate:
    """Mean and variance of the background's colors, per pixel of a frame."""

    def __init__(self) -> None:
        """Start empty."""
        self._mean = np.zeros((3, 0, 0), np.float32)
        self._variance = self._frames = np.zeros((0, 0), np.float32)
        self._gain = np.ones(3, np.float32)

    def align(self, image: Channels, background: PixelMask) -> None:
        """Estimate gains from a frame's sure background; forget everything if the camera has moved.

        The image's channels are in levels; another size than before rescales the plate.
        """
        self._gain = np.ones(3, np.float32)
        self._rescale(background.shape)
        some = np.s_[::7, ::7]
        known = background[some] & (self._frames[some] >= MIN_SEEN_FRAMES)
        if known.sum() < 50:
            return
        seen, before = (
            np.stack([plane[some][known] for plane in planes]) for planes in (image, self._mean)
        )
        alike = np.ones(seen.shape[1], dtype=bool)
        for _ in range(2):  # again without what does not fit
            count = np.float32(alike.sum())  # of one level: a black background has gain 1
            total = (before[:, alike] ** 2).sum(axis=1) + count
            self._gain = ((seen[:, alike] * before[:, alike]).sum(axis=1) + count) / total
            alike = np.abs(seen - self._gain[:, None] * before).max(axis=0) < 12.0  # levels
            # Before static cameras at most 0.1 changes (texts, shadows, passers-by), before held
            # ones 0.2 to 0.3; a gain below 0.2 is a frame without light.
            if alike.mean() < 0.88 or self._gain.min() < 0.2:
                self._frames[:] = 0.0
                self._gain = np.ones(3, np.float32)
                return

    def within(self, part: tuple[slice, slice]) -> PlateColors:
        """The background in some rows and columns of the aligned frame."""
        frames = self._frames[part]
        # The mean of a few frames is uncertain itself.
        variance = np.maximum(self._variance[part], 6.0**2)  # at least 6 levels
        variance *= 1.0 + 2.0 / np.maximum(frames, 1.0)
        mean = self._mean[:, part[0], part[1]] * self._gain[:, None, None]
        return PlateColors(frames >= MIN_SEEN_FRAMES, mean, variance)

    def update(self, image: Channels, background: PixelMask) -> None:
        """Average the sure background of the aligned frame into the plate."""
        self._frames += background
        share = background / np.clip(self._frames, 1.0, 30.0)
        squared = np.zeros_like(self._variance)
        for seen, mean, gain in zip(image, self._mean, self._gain, strict=True):
            off = seen / gain - mean
            mean += off * share
            squared += off * off
        # Welford 1962: the variance takes the squared deviation across the old and the new mean.
        squared *= (1.0 - share) / 3.0
        self._variance += share * (squared - self._variance)

    def _rescale(self, shape: tuple[int, int]) -> None:
        """Change the plate's resolution; an empty one is made."""
        if self._frames.shape == shape:
            return
        if not self._frames.size:
            self._mean = np.zeros((3, *shape), np.float32)
            self._variance, self._frames = np.zeros((2, *shape), np.float32)
            return
        planes = (*self._mean, self._variance, self._frames)
        scaled = [np.asarray(cv2.resize(each, shape[::-1]), np.float32) for each in planes]
        self._mean, self._variance, self._frames = np.stack(scaled[:3]), scaled[3], scaled[4]


@final
class DarkFilmBrightener:
    """Brightens the frames of a dark film, and leaves those of others as they are."""

    def __init__(self) -> None:
        """Starts before the first frame."""
        self._brightest = 1.0

    def __call__(self, rgb: RgbImage) -> RgbImage:
        """Brighten the next frame, as much as the brightest one until now allows: some fade in."""
        if self._brightest < DARK_LEVEL:
            level = float(np.percentile(rgb[::4, ::4], 98))
            self._brightest = max(self._brightest, level)
        if self._brightest >= DARK_LEVEL:
            return rgb
        smooth = cv2.GaussianBlur(rgb.astype(np.float32), (0, 0), 1.0)
        return np.clip(BRIGHT_LEVEL / self._brightest * smooth, 0.0, 255.0).astype(np.uint8)

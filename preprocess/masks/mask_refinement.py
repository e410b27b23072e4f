"""Sharp masks from a tracker's soft ones: what the network saw, joined with the frame's colors.

The network's mask is coarse: a pixel of its square is several of the frame, fingers and the gap
between arm and trunk are lost. It is right at large, though, so only a band around its border is
decided again, by Bayes' rule: the network's probability is the prior; the likelihoods are those of
a pixel's color under the colors of person and background nearby, under the histograms of both, and,
where a static camera has seen it, under the background itself (`BackgroundPlate`). Where
its texture is in plain sight, there is no person. A guided filter makes neighbors of like color
agree and carries the result to full size; before a known background, the border is then moved to
where the colors change (`refine_border`).
"""

from typing import NamedTuple, final

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

from preprocess.masks.color_models import (
    BackgroundPlate,
    DarkFilmBrightener,
    PlateColors,
    color_density,
    local_densities,
)
from preprocess.masks.matting import apply_coefficients, guided_coefficients, refine_border
from preprocess.tracking.keypoints import CroppedMask

WORKING_SCALE = 2.0
"""Pixels of the working image for each pixel of the network's square, about; the working image is
the frame, or smaller by a whole number."""
RESCALE_MARGIN = 0.4
"""How far that number must be from the best before it changes."""

OUTER_BAND, INNER_BAND = 6.0, 6.0
"""Reach of the band outside and inside the mask's border, in the network's pixels."""
MARGIN = 2.0
"""Width of the background beyond the band that is looked at, in the network's pixels."""
SURE_PERSON, SURE_PERSON_DEPTH = 0.9, 1.5
"""Probability, and distance from the border, of pixels that teach the person's colors."""
SURE_BACKGROUND, SURE_BACKGROUND_DISTANCE = 0.1, 2.5
"""Probability, and distance from the border, of pixels that teach the background's colors."""

LOCAL_SIGMA = 3.0
"""Gaussian σ of the neighborhood from which colors are learnt, in the network's pixels."""
UNSEEN_BACKGROUND = 0.00025
"""Least density of a color where the background is known (`color_density`)."""
SHADOW_GAIN = 0.6, 1.05
"""Range of the factors by which the person's shadow and reflected light change the background."""
SHADOW_PROBABILITY = 0.1
"""Probability that a background pixel is shaded or lit by the person."""

LOCAL_WEIGHT, PLATE_WEIGHT, HISTOGRAM_WEIGHT = 0.5, 1.0, 0.75
"""Weights of the three log likelihood ratios."""
MAX_LOG_RATIO = 8.0
"""Bound of their sum."""
HISTOGRAM_MEMORY = 0.9
"""Share of earlier frames in the histograms."""

FILTER_RADIUS_PX = 3
"""Radius of the guided filter's windows in the working image, px."""
FILTER_TOLERANCE = 5.0
"""Standard deviation of colors, in levels, that the guided filter does not follow."""
CONTRAST = 2.0
"""Steepening of the filtered mask around 1/2."""
SURE_ALPHA = 0.8
"""Alpha above which a pixel teaches the person's color beside the border."""
NEARBY_PX = 3
"""Edge of the window in which it does, in twice the working image's pixels."""
NEARBY_SPREAD = 14.0
"""Standard deviation of a color that the window's mean misses, in levels."""
PERSON_FREE_ALPHA = 0.05
"""Alpha below which a pixel enters the background plate."""

Plane = Float32[np.ndarray, "height width"]
Channels = Float32[np.ndarray, "3 height width"]
PixelMask = Bool[np.ndarray, "height width"]
Pixels = Float32[np.ndarray, "pixels"]


class _Band(NamedTuple):
    """The part of a working image around the person, and what the network says of it.

    Attributes:
        image: The three channels, in levels.
        corner: Row and column of its first pixel in the working image.
        prior: The network's probability of person.
        inside: Pixels that are more likely person.
        person, background: Pixels that are surely so, for learning colors.
        rows, columns: The pixels of the band.
        colors: Their colors, in levels.
    """

    image: Channels
    corner: tuple[int, int]
    prior: Plane
    inside: PixelMask
    person: PixelMask
    background: PixelMask
    rows: Int[np.ndarray, "pixels"]
    columns: Int[np.ndarray, "pixels"]
    colors: Float32[np.ndarray, "3 pixels"]


@final
class MaskRefiner:
    """Refines the masks of one person in the frames of one camera, in their order."""

    def __init__(self, frame_px: tuple[int, int]) -> None:
        """Start without knowledge of background and person.

        Args:
            frame_px: Width and height of the frames.
        """
        self._frame_px = frame_px
        self._brighten, self._plate = DarkFilmBrightener(), BackgroundPlate()
        self._reduction = 0
        self._histograms = np.zeros((2, 16**3), np.float32)

    def __call__(
        self,
        rgb: UInt8[np.ndarray, "rows columns 3"],
        mask: CroppedMask,
        size_px: tuple[int, int] | None = None,
    ) -> Plane:
        """Refine the mask of the next frame.

        Args:
            rgb: The frame.
            mask: The tracker's mask.
            size_px: Width and height of the result; None for the frame's.

        Returns:
            How far each pixel is person, in [0, 1].
        """
        alpha = self._refine(self._brighten(rgb), mask)
        if size_px is None or size_px == self._frame_px:
            return alpha
        way = cv2.INTER_AREA if size_px[0] < self._frame_px[0] else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(alpha, size_px, interpolation=way), np.float32)

    def _refine(self, rgb: UInt8[np.ndarray, "rows columns 3"], mask: CroppedMask) -> Plane:
        square_px = float(np.hypot(*mask.image_from_crop[:, 0]))
        best = square_px / WORKING_SCALE
        if abs(self._reduction - best) > 0.5 + RESCALE_MARGIN or not self._reduction:
            self._reduction = max(1, round(best))
        times = self._reduction
        working_px = self._frame_px[0] // times, self._frame_px[1] // times
        whole_px = working_px[0] * times, working_px[1] * times  # a frame's last pixels may be cut
        small = rgb[: whole_px[1], : whole_px[0]]
        if times > 1:
            small = cv2.resize(small, working_px, interpolation=cv2.INTER_AREA)
        image = np.stack(cv2.split(small)).astype(np.float32)
        band, far = _find_band(image, mask.resample(whole_px, working_px), square_px / times)
        self._plate.align(image, far)
        found = np.zeros(self._frame_px[::-1], np.float32)
        if band is not None:
            (top, left), (height, width) = band.corner, band.prior.shape
            part = np.s_[top : top + height, left : left + width]
            plate = self._plate.within(part)
            alpha = self._decide(band, plate, square_px / times)
            fitted = guided_coefficients(band.image, alpha, FILTER_RADIUS_PX, FILTER_TOLERANCE)
            filtered = apply_coefficients(band.image, fitted)
            person = filtered > PERSON_FREE_ALPHA
            far[part] = cv2.dilate(person.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
            there = np.s_[
                top * times : (top + height) * times, left * times : (left + width) * times
            ]
            moved = _move_border(band.image, _steepen(filtered), plate)
            found[there] = _enlarge(rgb[there], fitted, times, moved)
        self._plate.update(image, far)
        return found

    def _decide(self, band: _Band, plate: PlateColors, unit_px: float) -> Plane:
        """Probability of person in the band, and 0 or 1 beyond it."""
        shown = plate.in_sight(band.image)
        band = band._replace(person=band.person & ~shown, background=band.background | shown)
        at = band.rows, band.columns
        front, back = local_densities(
            band.image, (band.person, band.background), at, LOCAL_SIGMA * unit_px
        )
        ratio = np.float32(LOCAL_WEIGHT) * np.log(front / back)
        known = plate.known[at]
        rows, columns = band.rows[known], band.columns[known]
        behind = _plate_density(
            band.colors[:, known], plate.mean[:, rows, columns], plate.variance[rows, columns]
        )
        ratio[known] = np.float32(PLATE_WEIGHT) * np.log(front[known] / behind)
        ratio += np.float32(HISTOGRAM_WEIGHT) * self._histogram_ratio(band)
        prior = np.clip(band.prior[at], np.float32(0.01), np.float32(0.99))
        odds = prior / (np.float32(1.0) - prior)
        odds *= np.exp(np.clip(ratio, np.float32(-MAX_LOG_RATIO), np.float32(MAX_LOG_RATIO)))
        alpha = band.inside.astype(np.float32)
        alpha[at] = odds / (np.float32(1.0) + odds)
        alpha[shown] = 0.0
        return _without_islands(alpha, band.inside)

    def _histogram_ratio(self, band: _Band) -> Pixels:
        """Log ratio of the colors' frequencies on the person and around them."""
        some = np.s_[::2, ::2]
        bins = _color_bins(band.image[:, ::2, ::2])
        now = np.stack(
            [
                np.bincount(bins[each[some]], minlength=16**3)
                for each in (band.person, band.background)
            ]
        ).astype(np.float32)
        kept = np.float32(HISTOGRAM_MEMORY) if self._histograms.any() else np.float32(0.0)
        self._histograms = kept * self._histograms + (np.float32(1.0) - kept) * now
        total = np.maximum(self._histograms.sum(axis=1, keepdims=True), np.float32(1e-3))
        front, back = self._histograms / total + np.float32(1e-4)
        return np.log(front / back)[_color_bins(band.colors)]


def _find_band(image: Channels, soft: Plane, unit_px: float) -> tuple[_Band | None, PixelMask]:
    """The band around a soft mask's border, and the pixels beyond it.

    Args:
        image: The working image's channels.
        soft: The network's mask of it.
        unit_px: Edge of the network's pixel in it, px.
    """
    far = np.ones(soft.shape, dtype=bool)
    left, top, width, height = cv2.boundingRect((soft > 0.5).astype(np.uint8))
    if not width:
        return None, far
    margin = int((OUTER_BAND + MARGIN) * unit_px) + 1
    top, bottom = max(top - margin, 0), min(top + height + margin, soft.shape[0])
    left, right = max(left - margin, 0), min(left + width + margin, soft.shape[1])
    around = np.s_[top:bottom, left:right]
    prior = np.ascontiguousarray(soft[around])
    inside = prior > 0.5
    hard = inside.astype(np.uint8)
    out = cv2.distanceTransform(1 - hard, cv2.DIST_L2, 3)
    depth = cv2.distanceTransform(hard, cv2.DIST_L2, 3)
    far[around] = beyond = out > OUTER_BAND * unit_px
    deep = depth > INNER_BAND * unit_px
    rows, columns = np.nonzero(~(beyond | deep))
    part = np.ascontiguousarray(image[:, top:bottom, left:right])
    index = rows * part.shape[2] + columns
    return _Band(
        image=part,
        corner=(top, left),
        prior=prior,
        inside=inside,
        person=deep | ((prior > SURE_PERSON) & (depth > SURE_PERSON_DEPTH * unit_px)),
        background=beyond
        | ((prior < SURE_BACKGROUND) & (out > SURE_BACKGROUND_DISTANCE * unit_px)),
        rows=rows,
        columns=columns,
        colors=np.stack([plane.ravel()[index] for plane in part]),
    ), far


def _without_islands(alpha: Plane, inside: PixelMask) -> Plane:
    """Clear parts that are cut off from the person, unless the network saw person there."""
    _, found = cv2.connectedComponents((alpha > 0.5).astype(np.uint8), ltype=cv2.CV_16U)
    labels = np.asarray(found, dtype=np.uint16)
    kept = np.zeros(2**16, np.float32)
    kept[0] = 1.0  # what is less likely person
    kept[labels[inside]] = 1.0
    return alpha * kept[labels]


def _plate_density(
    colors: Float32[np.ndarray, "3 pixels"],
    mean: Float32[np.ndarray, "3 pixels"],
    variance: Pixels,
) -> Pixels:
    """Density of colors where the background is known, as it is or in the person's shadow.

    A shadow has the background's color, only darker (Horprasert et al. 1999, a statistical approach
    for background subtraction and shadow detection).
    """
    dot = colors[0] * mean[0] + colors[1] * mean[1] + colors[2] * mean[2]
    length = np.maximum(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2, np.float32(1.0))
    gain = np.clip(dot / length, np.float32(SHADOW_GAIN[0]), np.float32(SHADOW_GAIN[1]))
    plain, shaded = np.zeros((2, len(dot)), np.float32)
    for color, expected in zip(colors, mean, strict=True):
        plain += (color - expected) ** 2
        shaded += (color - gain * expected) ** 2
    return (
        np.float32(1.0 - SHADOW_PROBABILITY) * color_density(plain, variance)
        + np.float32(SHADOW_PROBABILITY) * color_density(shaded, variance)
        + np.float32(UNSEEN_BACKGROUND)
    )


def _color_bins(colors: Float32[np.ndarray, "3 *pixels"]) -> Int[np.ndarray, "*pixels"]:
    """Number of each color's bin of 16 x 16 x 16."""
    red, green, blue = colors.astype(np.int32) >> 4
    return (red << 8) | (green << 4) | blue


def _steepen(alpha: Plane) -> Plane:
    """Steepen a mask around 1/2."""
    steep = np.float32(CONTRAST) * alpha + np.float32(0.5 - 0.5 * CONTRAST)
    return np.clip(steep, np.float32(0.0), np.float32(1.0))


def _move_border(image: Channels, alpha: Plane, plate: PlateColors) -> Plane:
    """How much more person a pixel is, by its color between the person's and the background's."""
    sure = cv2.erode((alpha > SURE_ALPHA).astype(np.uint8), np.ones((3, 3), np.uint8))
    size_px, window = alpha.shape[::-1], (NEARBY_PX, NEARBY_PX)
    half_px = (size_px[0] + 1) // 2, (size_px[1] + 1) // 2
    weight, *planes = (
        cv2.resize(each, half_px, interpolation=cv2.INTER_AREA)
        for each in (sure.astype(np.float32), *image)
    )
    inverse = np.float32(1.0) / np.maximum(cv2.blur(weight, window), np.float32(1e-6))
    front = [cv2.blur(plane * weight, window) * inverse for plane in planes]
    total = planes[0] ** 2 + planes[1] ** 2 + planes[2] ** 2
    spread = cv2.blur(total * weight, window) * inverse
    spread -= front[0] ** 2 + front[1] ** 2 + front[2] ** 2
    spread = np.sqrt(np.maximum(spread, np.float32(0.0)) / np.float32(3.0) + NEARBY_SPREAD**2)
    spread[inverse > 1e5] = np.inf
    person = cv2.resize(cv2.merge(front), size_px)
    behind = np.where(plate.known, np.sqrt(plate.variance), np.float32(np.inf))
    colors, before = (np.moveaxis(each, 0, 2) for each in (image, plate.mean))
    known = cv2.resize(spread.astype(np.float32), size_px, interpolation=cv2.INTER_NEAREST)
    return refine_border(colors, alpha, (before, behind), (person, known)) - alpha


def _enlarge(
    rgb: UInt8[np.ndarray, "rows columns 3"],
    coefficients: Float32[np.ndarray, "4 height width"],
    times: int,
    moved: Plane,
) -> Float32[np.ndarray, "rows columns"]:
    """The mask at full size: the filter's coefficients, enlarged and applied, and moved."""
    size_px = rgb.shape[1], rgb.shape[0]

    def full(plane: Plane) -> Float32[np.ndarray, "rows columns"]:
        return plane if times == 1 else cv2.resize(plane, size_px)

    alpha = full(coefficients[3])
    for channel, slope in zip(cv2.split(np.ascontiguousarray(rgb)), coefficients, strict=False):
        alpha = alpha + cv2.multiply(channel, full(slope), dtype=cv2.CV_32F)
    return np.clip(_steepen(alpha) + full(moved), np.float32(0.0), np.float32(1.0))

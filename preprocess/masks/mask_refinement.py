"""Sharp masks: a tracker's soft ones, and given ones whose borders miss the edges in the image.

The network's mask is coarse: a pixel of its square is several of the frame, fingers and the gap
between arm and trunk are lost. It is right at large, though, so only a band around its border is
decided again, by Bayes' rule: the network's probability is the prior; the likelihoods are those of
a pixel's color under the histograms of person and background, and, where a static camera has seen
it, under the background itself (`BackgroundPlate`). Where its texture is in plain sight, there is
no person. A guided filter makes neighbors of like color agree and carries the result to full size;
before a known background, the border is then moved to where the colors change (`refine_border`).

Given masks are right where the image changes along their border: color is a mixture of person and
background by alpha, so that the image's gradient follows that of alpha. They are refined in the
same way and the two borders compared; only if the image changes clearly more along the refined
one is it used. Exact masks stay as they are.
"""

from typing import NamedTuple, final

import cv2
import numpy as np
from jaxtyping import Float32, Int

from capture.source import RgbImage
from preprocess.masks.color_models import (
    BackgroundPlate,
    Channels,
    DarkFilmBrightener,
    FullImage,
    FullPlane,
    PixelMask,
    Pixels,
    Plane,
    PlateColors,
    plate_density,
)
from preprocess.masks.matting import (
    apply_coefficients,
    enlarge_alpha,
    guided_coefficients,
    move_border,
    steepen,
)
from preprocess.tracking.keypoints import CroppedMask

BAND = 6.0
"""Reach of the band outside and inside the mask's border, in the network's pixels."""
COMPARED_FRAMES = 10
"""Frames whose borders are compared; what they say holds for all others."""
SQUARE_PX = 256
"""Width and height of the square that holds the person, as in a tracker's masks."""


class _Band(NamedTuple):
    """The part of a working image around the person, and the network's mask of it.

    Attributes:
        image: The three channels, in levels.
        corner: Row and column of its first pixel in the working image.
        prior: The network's probability of person.
        inside: Pixels that are more likely person.
        person, background: Pixels that are surely so, for learning colors.
        rows, columns, colors: The pixels of the band, and their colors in levels.
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
        """Start without knowledge of background and person, for frames of one width and height."""
        self._frame_px = frame_px
        self._brighten, self._plate = DarkFilmBrightener(), BackgroundPlate()
        self._reduction = 0
        self._histograms = np.zeros((2, 16**3), np.float32)

    def __call__(
        self, rgb: FullImage, mask: CroppedMask, size_px: tuple[int, int] | None = None
    ) -> Plane:
        """Refine the next frame's mask, in [0, 1], at `size_px` (width, height) or the frame's."""
        alpha = self._refine(self._brighten(rgb), mask)
        if size_px is None or size_px == self._frame_px:
            return alpha
        way = cv2.INTER_AREA if size_px[0] < self._frame_px[0] else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(alpha, size_px, interpolation=way), np.float32)

    def _refine(self, rgb: FullImage, mask: CroppedMask) -> Plane:
        square_px = float(np.hypot(*mask.image_from_crop[:, 0]))
        best = square_px / 2.0  # the working image has two pixels for each of the network's
        if abs(self._reduction - best) > 0.9 or not self._reduction:
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
            alpha = self._decide(band, plate)
            fitted = guided_coefficients(band.image, alpha, radius_px=3, tolerance=5.0)
            filtered = apply_coefficients(band.image, fitted)
            person = filtered > 0.05  # below, pixels enter the background plate
            far[part] = cv2.dilate(person.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
            there = np.s_[
                top * times : (top + height) * times, left * times : (left + width) * times
            ]
            moved = move_border(band.image, steepen(filtered), plate)
            found[there] = enlarge_alpha(rgb[there], fitted, times, moved)
        self._plate.update(image, far)
        return found

    def _decide(self, band: _Band, plate: PlateColors) -> Plane:
        """Probability of person in the band, and 0 or 1 beyond it."""
        shown = plate.in_sight(band.image)
        band = band._replace(person=band.person & ~shown, background=band.background | shown)
        at = band.rows, band.columns
        front, back = self._color_frequencies(band)
        ratio = 0.75 * np.log(front / back)
        known = plate.known[at]
        rows, columns = band.rows[known], band.columns[known]
        behind = plate_density(
            band.colors[:, known], plate.mean[:, rows, columns], plate.variance[rows, columns]
        )
        # 32: twice the density of a bin of 16 levels in `color_density`'s unit
        ratio[known] += np.log(32.0 * front[known] / behind)
        prior = np.clip(band.prior[at], 0.01, 0.99)
        odds = prior / (1.0 - prior)
        odds *= np.exp(np.clip(ratio, -8.0, 8.0))
        alpha = band.inside.astype(np.float32)
        alpha[at] = odds / (1.0 + odds)
        alpha[shown] = 0.0
        return _without_islands(alpha, band.inside)

    def _color_frequencies(self, band: _Band) -> tuple[Pixels, Pixels]:
        """Frequencies of the band's colors on the person, and around them."""
        some = np.s_[::2, ::2]
        bins = _color_bins(band.image[:, ::2, ::2])
        now = np.stack(
            [
                np.bincount(bins[each[some]], minlength=16**3)
                for each in (band.person, band.background)
            ]
        ).astype(np.float32)
        kept = np.float32(0.9) if self._histograms.any() else np.float32(0.0)
        self._histograms = kept * self._histograms + (np.float32(1.0) - kept) * now
        total = np.maximum(self._histograms.sum(axis=1, keepdims=True), 1e-3)
        front, back = self._histograms / total + 3e-4
        bins = _color_bins(band.colors)
        return front[bins], back[bins]


def _find_band(image: Channels, soft: Plane, unit_px: float) -> tuple[_Band | None, PixelMask]:
    """The band around a soft mask's border, and the pixels beyond it.

    `unit_px` is the edge of one of the network's pixels in the working image, px.
    """
    far = np.ones(soft.shape, dtype=bool)
    left, top, width, height = cv2.boundingRect((soft > 0.5).astype(np.uint8))
    if not width:
        return None, far
    margin = int((BAND + 2.0) * unit_px) + 1
    top, bottom = max(top - margin, 0), min(top + height + margin, soft.shape[0])
    left, right = max(left - margin, 0), min(left + width + margin, soft.shape[1])
    around = np.s_[top:bottom, left:right]
    prior = np.ascontiguousarray(soft[around])
    inside = prior > 0.5
    hard = inside.astype(np.uint8)
    out = cv2.distanceTransform(1 - hard, cv2.DIST_L2, 3)
    depth = cv2.distanceTransform(hard, cv2.DIST_L2, 3)
    far[around] = beyond = out > BAND * unit_px
    deep = depth > BAND * unit_px
    rows, columns = np.nonzero(~(beyond | deep))
    part = np.ascontiguousarray(image[:, top:bottom, left:right])
    index = rows * part.shape[2] + columns
    return _Band(
        image=part,
        corner=(top, left),
        prior=prior,
        inside=inside,
        person=deep | ((prior > 0.9) & (depth > 1.5 * unit_px)),
        background=beyond | ((prior < 0.1) & (out > 2.5 * unit_px)),
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


def _color_bins(colors: Float32[np.ndarray, "3 *pixels"]) -> Int[np.ndarray, "*pixels"]:
    """Number of each color's bin of 16 x 16 x 16."""
    red, green, blue = colors.astype(np.int32) >> 4
    return (red << 8) | (green << 4) | blue


@final
class GivenMaskRefiner:
    """Refines the masks of a recording or a stream, frame by frame in order, if that is needed."""

    def __init__(self, *, enabled: bool = True) -> None:
        """Start before the first frame; masks stay as they are unless it is `enabled`."""
        self._enabled = enabled
        self._refiner: MaskRefiner | None = None
        self._size_px = (0, 0)
        self._ratios: list[float] = []

    @property
    def is_needed(self) -> bool:
        """True if masks are refined, by the frames that were seen; at first they are not."""
        # noise in the images alone makes it up to 1.12
        return bool(self._ratios) and float(np.mean(self._ratios)) >= 1.15

    @property
    def note(self) -> str | None:
        """Note for the user; None if the masks stay as they are."""
        if not self.is_needed:
            return None
        return (
            "The borders of the given masks miss the edges in the pictures and were refined (edges "
            f"are {np.mean(self._ratios):.1f} times as strong along the refined ones). "
            "--no-refine-masks uses the masks as they are."
        )

    @property
    def keeps_given_masks(self) -> bool:
        """True once it is known that the given masks need no refinement, or shall have none."""
        decided = not self._enabled or len(self._ratios) >= COMPARED_FRAMES
        return decided and not self.is_needed

    def __call__(self, rgb: FullImage, alpha: FullPlane, size_px: tuple[int, int]) -> Plane:
        """Refine the next frame's mask, unless the given one is as good; scaled to `size_px`."""
        found = alpha
        if not self.keeps_given_masks and (alpha > 0.5).any():
            refined = self._refine(rgb, alpha)
            if len(self._ratios) < COMPARED_FRAMES:
                given = edge_strength(rgb, alpha)
                self._ratios.append(edge_strength(rgb, refined) / max(given, 1e-6))
            found = refined if self.is_needed else alpha
        if size_px == (rgb.shape[1], rgb.shape[0]):
            return found
        return np.asarray(cv2.resize(found, size_px, interpolation=cv2.INTER_AREA), np.float32)

    def _refine(self, rgb: FullImage, alpha: FullPlane) -> FullPlane:
        size_px = rgb.shape[1], rgb.shape[0]
        if self._refiner is None or size_px != self._size_px:
            self._refiner, self._size_px = MaskRefiner(size_px), size_px
        return self._refiner(rgb, _crop(alpha))


def edge_strength(rgb: RgbImage, alpha: Plane) -> float:
    """Change of color across a mask's border, levels per pixel.

    It is the mean over the border, weighted by the gradient of alpha.
    """
    border, slopes = _gradient(alpha), [_gradient(channel) for channel in cv2.split(rgb)]
    steepness = np.hypot(*border)
    across = [(border[0] * x + border[1] * y) / np.maximum(steepness, 1e-6) for x, y in slopes]
    change = np.sqrt(sum(each**2 for each in across))
    return float((change * steepness).sum() / max(float(steepness.sum()), 1e-6))


def _gradient(plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Change per pixel to the right and down (Scharr)."""
    x, y = (cv2.Scharr(plane, cv2.CV_32F, *axis, scale=1.0 / 32.0) for axis in ((1, 0), (0, 1)))
    return x, y


def _crop(alpha: Plane) -> CroppedMask:
    """The square around the person, as a tracker would cut it out."""
    rows, columns = np.nonzero(alpha > 0.5)
    low = np.array([columns.min(), rows.min()], np.float64)
    high = np.array([columns.max(), rows.max()], np.float64) + 1.0
    scale = 1.25 * float((high - low).max()) / SQUARE_PX
    corner = 0.5 * (low + high) - 0.5 * SQUARE_PX * scale
    image_from_crop = np.column_stack([scale * np.eye(2), corner])
    there = image_from_crop.copy()
    there[:, 2] += 0.5 * scale - 0.5  # to OpenCV's pixels, whose middles are at 0
    way = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    values = cv2.warpAffine(255.0 * alpha, there, (SQUARE_PX, SQUARE_PX), flags=way)
    return CroppedMask(values=np.rint(values).astype(np.uint8), image_from_crop=image_from_crop)

"""Quality of a rendered image: PSNR, SSIM, soft IoU, and its sharpness in one word.

The word is sharp, soft, blurred or failed. A PSNR alone does not say whether an image is good. On
white it depends on how much of the frame the person fills, and inside the mask on the clothes: a
plain shirt scores well however it is drawn, a striped one badly as soon as it is a pixel off. Each
held-out frame is therefore its own scale. The frame is blurred by Gaussians of growing width, each
blurred copy is scored as a rendering would be (PSNR where alpha > 0.5, on white), and the rendering
is given the width of the copy that scores as it does: its **equivalent blur**, the standard
deviation σ as a share of the person's height in the image. A shift of the person counts as blur,
too.

The verdict on an image, or on several (`overall_verdict`), comes from the equivalent blur and from
the **overlap** of the rendered alpha with the mask (`soft_iou`: 1 where they agree,
low for fog and for a body that does not cover its mask):

| verdict | equivalent blur at most | on a person of 1.75 m | what is seen |
|---|---|---|---|
| sharp | 0.75 % | 1.3 cm | fingers, eyes, seams |
| soft | 1.25 % | 2.2 cm | a face that can be recognised, hands without fingers |
| blurred | 8 % | 14 cm | a person, whose face and hands are smears |
| failed | more, or an overlap below 0.5 | | no avatar of this person |

Where the bounds come from: the sample's actor (96 px, poses exact) has 0.74 % at 37 dB and 1.2 %
at 27 dB after 45 steps; with poses 6° and 4 cm off, 4 and 8 % with overlaps of 0.68 and 0.59 in two
frames, at 19 dB. The real person of eight photographs has 1.2 and 1.6 % at 22.8 dB in the given
poses. Fog has an overlap of 0.38 (26 steps, 13 dB) to 0.47 (24 steps, 18 dB). A run that
reconstructed the room instead of the person (masks that cover everything) has 0.15 to 0.27 at
7.8 dB, beyond the widest blur. 14 cm is thicker than an arm or a leg: an image that is blurred by
more shows no person any longer.
"""

from collections.abc import Iterable
from itertools import pairwise
from math import exp, inf, isnan, log, nan
from statistics import median_high, median_low
from typing import Literal, Protocol, get_args, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Shaped

from preprocess.observation import Observation

MASK_THRESHOLD = 0.5
"""Alpha above which a pixel belongs to the person."""


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
    """Ground truth of a rendering over a gray: alpha · color + (1 - alpha) · background.

    The color is the person's own, without the background that the image's borders hold.
    """
    alpha = observation.alpha[..., None]
    picture = observation.person_colors() / np.float32(255.0)
    return alpha * picture + np.float32(background) * (1.0 - alpha)


def ground_truth_on_white(observation: Observation) -> Float32[np.ndarray, "height width 3"]:
    """Ground truth of a rendering on white: alpha · color + (1 - alpha) · white."""
    return ground_truth_over(observation, 1.0)


def psnr(
    image: Float[np.ndarray, "height width 3"],
    truth: Float[np.ndarray, "height width 3"],
    mask: Bool[np.ndarray, "height width"] | None = None,
) -> float:
    """Peak signal-to-noise ratio in dB of images in [0, 1]; infinite if they are equal.

    `mask` selects the pixels that count; an empty one gives NaN.
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
    """Mean structural similarity (Wang et al. 2004), in [-1, 1]: Gaussian of 11 taps, σ = 1.5.

    Pixels without a whole window do not count; NaN of images that are smaller than it.
    """
    if min(image.shape[:2]) < 11:
        return float("nan")
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    taps /= taps.sum()

    def blurred(picture: np.ndarray) -> np.ndarray:
        return np.asarray(cv2.sepFilter2D(picture, cv2.CV_64F, taps, taps))[5:-5, 5:-5]

    a, b = image.astype(np.float64), truth.astype(np.float64)
    mean_a, mean_b = blurred(a), blurred(b)
    var_a, var_b = blurred(a * a) - mean_a**2, blurred(b * b) - mean_b**2
    both = blurred(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    similarity = ((2 * mean_a * mean_b + c1) * (2 * both + c2)) / (
        (mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2)
    )
    return float(similarity.mean())


SharpnessVerdict = Literal["sharp", "soft", "blurred", "failed"]
"""Verdicts from the best to the worst."""
MAX_SHARP_BLUR = 0.0075
"""Largest equivalent blurs of sharp and soft images, as shares of the person's height."""
MAX_SOFT_BLUR = 0.0125
MAX_MEASURABLE_BLUR = 0.08
"""Largest equivalent blur of a blurred image; beyond it the avatar has failed."""
MIN_OVERLAP = 0.5
"""Overlap below which the image does not show the body of the mask."""
CALIBRATION_BLURS = (0.0025, 0.005, 0.01, 0.02, 0.04, MAX_MEASURABLE_BLUR)
"""Blurs of the calibration, as shares of the person's height."""


@runtime_checkable
class SharpnessScore(Protocol):
    """A score with an equivalent blur and an overlap."""

    @property
    def blur(self) -> float:
        """Equivalent blur, as a share of the person's height; NaN if not measured."""
        ...

    @property
    def overlap(self) -> float:
        """Soft IoU of the rendered alpha and the mask, in [0, 1]; NaN if not measured."""
        ...


BlurCalibration = tuple[float, ...]
"""PSNR of the truth blurred by each of `CALIBRATION_BLURS`, where alpha > 0.5, dB."""


def calibrate_blur(
    truth: Float32[np.ndarray, "height width 3"], silhouette: Bool[np.ndarray, "height width"]
) -> BlurCalibration:
    """Scores blurred copies of a frame on white; empty if the silhouette is."""
    rows = np.flatnonzero(silhouette.any(axis=1))
    if not rows.size:
        return ()
    height_px = float(rows[-1] - rows[0] + 1)
    return tuple(
        psnr(_gaussian_blur(truth, width * height_px), truth, silhouette)
        for width in CALIBRATION_BLURS
    )


def equivalent_blur(psnr_mask: float, calibration: BlurCalibration) -> float:
    """The blur that lowers a frame's PSNR as much, as a share of the person's height.

    `psnr_mask` is the rendering's where alpha > 0.5, dB. The blur is at least the first of
    `CALIBRATION_BLURS`; infinite beyond the last; NaN without a silhouette.
    """
    if not calibration or isnan(psnr_mask):
        return nan
    if psnr_mask >= calibration[0]:
        return CALIBRATION_BLURS[0]
    for (narrow, better), (wide, worse) in pairwise(
        zip(CALIBRATION_BLURS, calibration, strict=True)
    ):
        if psnr_mask >= worse:
            share = (better - psnr_mask) / (better - worse)
            return exp(log(narrow) + share * (log(wide) - log(narrow)))
    return inf


def sharpness_verdict(blur: float | None, overlap: float | None) -> SharpnessVerdict | None:
    """Verdict on an equivalent blur and an overlap; None if neither was measured."""
    if overlap is not None and overlap < MIN_OVERLAP:
        return "failed"
    if blur is None or isnan(blur):
        return None
    if blur > MAX_MEASURABLE_BLUR:
        return "failed"
    return "sharp" if blur <= MAX_SHARP_BLUR else "soft" if blur <= MAX_SOFT_BLUR else "blurred"


def median_blur(blurs: Iterable[float]) -> float | None:
    """Lower median of the blurs; None if none was measured."""
    known = [blur for blur in blurs if not isnan(blur)]
    return median_low(known) if known else None


def median_overlap(overlaps: Iterable[float]) -> float | None:
    """Upper median of the overlaps; None if none was measured."""
    known = [overlap for overlap in overlaps if not isnan(overlap)]
    return median_high(known) if known else None


def overall_verdict(scores: Iterable[SharpnessScore]) -> SharpnessVerdict | None:
    """Verdict that at least half of the images reach; None without any."""
    scores = list(scores)
    return sharpness_verdict(
        median_blur(score.blur for score in scores),
        median_overlap(score.overlap for score in scores),
    )


def better_verdict(
    one: SharpnessVerdict | None, other: SharpnessVerdict | None
) -> SharpnessVerdict | None:
    """The better of two verdicts on one avatar, as wrong poses are not its fault."""
    known: list[SharpnessVerdict] = [word for word in (one, other) if word is not None]
    return min(known, key=get_args(SharpnessVerdict).index) if known else None


def _gaussian_blur(
    picture: Float32[np.ndarray, "height width 3"], sigma_px: float
) -> Float32[np.ndarray, "height width 3"]:
    """Gaussian blur with mirrored borders."""
    height, width = picture.shape[:2]
    factor = int(sigma_px / 4.0)  # downsampled first: faster, and without visible loss
    if factor < 2:
        return np.asarray(cv2.GaussianBlur(picture, (0, 0), sigma_px))
    small = (max(1, width // factor), max(1, height // factor))
    shrunk = cv2.resize(picture, small, interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(shrunk, (0, 0), sigma_px * small[1] / height)
    return np.asarray(cv2.resize(blurred, (width, height), interpolation=cv2.INTER_LINEAR))

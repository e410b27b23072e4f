"""Person masks without a trained segmenter: GrabCut, seeded by the posed body and its appearance.

GrabCut (Rother et al. 2004) separates person and background by two mixtures of colors and by edges.
Alone it leaks into backgrounds of similar color. So the posed body, with the clothes that earlier
frames have shown on it (`ClothingOffset`), limits it to a narrow uncertain band around that shape.
If the camera is static, pixels that were background in earlier frames also predict what lies behind
the person (`BackgroundModel`). The mask is the mean of segmentation and shape, weighted by their
inverse variances; where they are far apart although the poses are good, the segmentation has
leaked. Last, where the background is known, border pixels are split by color (`refine_border`).

Masks are estimated at a working resolution that depends on the person's height in pixels.
"""

from typing import NamedTuple, final

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from capture.camera import Camera
from capture.frame import Frame
from capture.input_error import InputError
from preprocess.body.body_pose import BodyPose
from preprocess.body.parametric_body import ShapedBody
from preprocess.body.silhouette import signed_distance_px
from preprocess.masks.clothing_offset import (
    HAIR_BAND_M,
    HEAD_JOINT,
    OVERSHOOT_KNOWN_FRACTION,
    ClothedBody,
    ClothingOffset,
    head_region,
    solid_hair,
)
from preprocess.masks.color_models import AppearanceModel, BackgroundModel, VertexVisibility
from preprocess.masks.graph_cut import cut_foreground
from preprocess.masks.matting import border_distance_px, refine_border, soften_border

WORKING_PERSON_PX = 220
"""Height of the person, px, to which larger images are reduced before a mask is estimated."""

UPSAMPLE_BELOW_PX = 150
"""Height of the person, px, below which images are enlarged twice: masks gain sub-pixel detail."""

DOWNSAMPLE_ABOVE = 1.1
"""Ratio to `WORKING_PERSON_PX` from which an image is reduced."""

JOINT_HEIGHT_FRACTION = 0.87
"""Fraction of a standing person's height between head joint and toes."""

RESCALE_RATIO = 1.4
"""Change of the person's height, as a ratio, from which the scale is chosen again."""


@final
class WorkingResolution:
    """Scale of the images in which one person is segmented; it seldom changes."""

    def __init__(self, shaped: ShapedBody) -> None:
        """Start without a measured height."""
        self._shaped = shaped
        self._height_px: float | None = None

    def scale_for(self, pose: BodyPose, camera: Camera) -> float:
        """Size of the image to segment, relative to the frame."""
        joints = self._shaped.with_pose(pose).joints()
        depth = joints @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
        if depth.min() > 0.0:
            height_px = float(np.ptp(camera.project(joints), axis=0).max()) / JOINT_HEIGHT_FRACTION
            before = self._height_px
            if before is None or not 1.0 / RESCALE_RATIO < height_px / before < RESCALE_RATIO:
                self._height_px = height_px
        height_px = max(self._height_px or 0.0, 1.0)
        if height_px < UPSAMPLE_BELOW_PX:
            return 2.0
        return (
            1.0
            if height_px < DOWNSAMPLE_ABOVE * WORKING_PERSON_PX
            else WORKING_PERSON_PX / height_px
        )


UNKNOWN_BAND_M = 0.02
"""Half width of the uncertain band around the shape while clothes are unobserved, metres."""
KNOWN_BAND_M = 0.008
"""Half width of the uncertain band once clothes are observed all along the rim, metres."""
MIN_OUTER_BAND_M = 0.012
"""Least width of the band outside the shape, metres: with less, the shape could never grow."""

MAX_INNER_LIMIT_FRACTION = 0.1
"""Fraction of the border along the band's inner limit beyond which the pose is off: widen it."""
BAND_GROWTH_M = 0.012
"""Growth of the band after a frame in which the pose was off, metres."""
BAND_SHRINK_M = 0.002
"""Shrinking of the band after any other frame, metres."""
MAX_BAND_GROWTH_M = 0.05
"""Largest sum of growths, metres."""
OUTER_GROWTH_RATIO = 1.5
"""Growth of the band outside the shape relative to inside."""

BACKGROUND_MARGIN_M = 0.25
"""Width of the background around the band from which GrabCut learns its colors, metres."""

BACKGROUND_GAP_M = 0.015
"""Least distance of a background pixel from the person, metres at the body."""
BACKGROUND_GAP_PX = 2.0
"""Least distance of a background pixel from the person, px; both limits hold."""

ITERATIONS = 2
"""GrabCut iterations."""
FEWER_ITERATIONS = 1
"""GrabCut iterations where both clothes and background are known."""

DARK_LEVEL, BRIGHT_LEVEL = 80.0, 180.0
"""Level of the brightest pixels (2 %) below which a video is brightened, and the level after it."""
NOISE_BLUR_PX = 1.0
"""Gaussian σ, px, by which the noise of a dark video is smoothed."""

CUT_ERROR_M = 0.006
"""Standard error of the segmentation's border where it has not leaked, metres."""
MIN_SHAPE_ERROR_M = 0.002
"""Least standard error of the clothed shape's border, metres."""
UNKNOWN_SHAPE_ERROR_M = 0.012
"""Further standard error of the shape while clothes are unobserved, metres."""
INITIAL_SHAPE_ERROR_M = 0.012
"""Standard deviation between segmentation and shape that is assumed at first, metres."""

MIN_SHAPE_IOU = 0.4
"""Least IoU of a mask with the clothed shape; masks below it are rejected."""


class _ExpectedShape(NamedTuple):
    """The clothed body as it should appear in an image.

    Attributes:
        supersampled: Its shape, finer than the image.
        coverage: Fraction of each pixel that it covers.
        signed_distance_px: Distance of each pixel from its border, positive outside, px.
        hair_region: The pixels that may be hair.
    """

    supersampled: Float32[np.ndarray, "rows columns"]
    coverage: Float32[np.ndarray, "height width"]
    signed_distance_px: Float32[np.ndarray, "height width"]
    hair_region: Bool[np.ndarray, "height width"]


class _Segmentation(NamedTuple):
    """GrabCut's result for an image.

    Attributes:
        foreground: The person's pixels.
        signed_distance_px: Distance of each pixel from the person's border, positive outside, px.
        decided_by_background: 1 where the background model decided, else 0.
        band_m: Width of the uncertain band inside and outside the clothed shape, metres.
    """

    foreground: Bool[np.ndarray, "height width"]
    signed_distance_px: Float32[np.ndarray, "height width"]
    decided_by_background: Float32[np.ndarray, "height width"]
    band_m: tuple[float, float]


@final
class GrabCutSegmenter:
    """Segments one person, frame by frame.

    Attributes:
        name: Its name in the report.
        mask_count: Number of masks made.
        agreement: Mean IoU of these masks with the expected shape of body and clothes; 0 of none.
    """

    name = "GrabCut"

    def __init__(self, shaped: ShapedBody) -> None:
        """Start with unobserved clothes and background."""
        self._clothing, self._background = ClothingOffset(shaped), BackgroundModel()
        self._appearance = AppearanceModel(len(shaped.vertices))
        self._head = shaped.body.weights.argmax(axis=1) == HEAD_JOINT
        self._scale = WorkingResolution(shaped)
        self._wider_m = 0.0
        self._gain: float | None = None
        self._shape_error_m = INITIAL_SHAPE_ERROR_M
        self.mask_count, self.agreement = 0, 0.0

    def __call__(
        self, frame: Frame, pose: BodyPose, camera: Camera
    ) -> Float32[np.ndarray, "height width"]:
        """Estimate the mask of a frame; see `Segmenter`.

        Raises:
            InputError: If the body is outside the image, or the mask disagrees with it.
        """
        scale = self._scale.scale_for(pose, camera)
        size_px = (max(1, round(frame.size_px[0] * scale)), max(1, round(frame.size_px[1] * scale)))
        small, rgb = camera.resize(size_px), frame.rgb
        if size_px != frame.size_px:
            way = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
            rgb = cv2.resize(rgb, size_px, interpolation=way)
        rgb = self._brighten(rgb)
        around, shape = self._expected_shape(pose, small)
        self._background.reset_if_moved(
            small, rgb, shape.signed_distance_px > 2.0 * UNKNOWN_BAND_M * around.px_per_m
        )
        cut = self._segment(rgb, around, shape)
        expected = shape.signed_distance_px < 0.0
        both, either = (cut.foreground & expected).sum(), (cut.foreground | expected).sum()
        agreement = float(both / max(either, 1))
        if agreement < MIN_SHAPE_IOU:
            raise InputError(
                f"the estimated mask agrees by {agreement:.0%} only with the posed body"
            )
        alpha = soften_border(rgb, cut.foreground)
        self._update_models(rgb, cut, alpha, small, around, shape)
        weight = self._shape_weight(cut, shape, around)
        mixed = _blend(alpha, weight, shape, size_px)
        found = self._refine_border(rgb, mixed, around, small)
        self.mask_count += 1
        self.agreement += (agreement - self.agreement) / self.mask_count
        if size_px == frame.size_px:
            return found
        change = cv2.resize(found - mixed, frame.size_px, interpolation=cv2.INTER_LINEAR)
        return np.clip(_blend(alpha, weight, shape, frame.size_px) + change, 0.0, 1.0)

    def _brighten(
        self, rgb: UInt8[np.ndarray, "height width 3"]
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Brighten a dark video, all frames alike, and smooth its noise: limits are in levels."""
        if self._gain is None:
            bright = max(1.0, float(np.percentile(rgb, 98)))
            self._gain = BRIGHT_LEVEL / bright if bright < DARK_LEVEL else 1.0
        if self._gain == 1.0:
            return rgb
        smooth = cv2.GaussianBlur(rgb.astype(np.float32), (0, 0), NOISE_BLUR_PX)
        return np.clip(self._gain * smooth, 0.0, 255.0).astype(np.uint8)

    def _refine_border(
        self,
        rgb: UInt8[np.ndarray, "height width 3"],
        alpha: Float32[np.ndarray, "height width"],
        clothed: ClothedBody,
        camera: Camera,
    ) -> Float32[np.ndarray, "height width"]:
        """Move the border to where the colors change, if the background is known."""
        outside = border_distance_px(alpha)
        background = self._background.predict(rgb, outside > BACKGROUND_GAP_PX)
        if background is None:
            return alpha
        visibility = VertexVisibility.of(clothed, camera)
        self._appearance.update(visibility, rgb, -outside)
        foreground = self._appearance.predict(visibility, camera.size_px)
        return refine_border(rgb, alpha, background, foreground)

    def _expected_shape(self, pose: BodyPose, camera: Camera) -> tuple[ClothedBody, _ExpectedShape]:
        around = self._clothing.clothe(pose, camera)
        if around is None:
            raise InputError("the posed body is not in the image")
        fine = self._clothing.draw(around, camera)
        covered = cv2.resize(fine, camera.size_px, interpolation=cv2.INTER_AREA)
        hair = head_region(around.skin[self._head], camera, around.px_per_m)
        shape = _ExpectedShape(
            supersampled=fine,
            coverage=covered,
            signed_distance_px=signed_distance_px(covered > 0.5),
            hair_region=hair,
        )
        if (shape.signed_distance_px < 0.0).sum() < 16:
            raise InputError("the posed body is not in the image")
        return around, shape

    def _segment(
        self, rgb: UInt8[np.ndarray, "height width 3"], clothed: ClothedBody, shape: _ExpectedShape
    ) -> _Segmentation:
        """Separate person and background in the uncertain band around the clothed shape."""
        inwards = (
            clothed.known_fraction * KNOWN_BAND_M
            + (1.0 - clothed.known_fraction) * UNKNOWN_BAND_M
            + self._wider_m
        )
        outwards = max(inwards, MIN_OUTER_BAND_M) + (OUTER_GROWTH_RATIO - 1.0) * self._wider_m
        away = shape.signed_distance_px / clothed.px_per_m
        near = away < np.where(shape.hair_region, max(outwards, HAIR_BAND_M), outwards)
        doubtful = near & (away > -inwards)
        labels = np.full(away.shape, cv2.GC_BGD, np.uint8)
        labels[doubtful] = np.where(away[doubtful] < 0.0, cv2.GC_PR_FGD, cv2.GC_PR_BGD)
        like, unlike = self._background.classify(rgb, doubtful)
        labels[like], labels[unlike] = cv2.GC_PR_BGD, cv2.GC_PR_FGD
        labels[away <= -inwards] = cv2.GC_FGD
        settled = (
            self._background.is_initialized and clothed.known_fraction > OVERSHOOT_KNOWN_FRACTION
        )
        rounds = FEWER_ITERATIONS if settled else ITERATIONS
        margin = int(BACKGROUND_MARGIN_M * clothed.px_per_m) + 1
        person = cut_foreground(rgb, labels, near, margin, rounds)
        if person is None:
            person = (labels & 1) > 0
        person = (person & ~like) | unlike
        return _Segmentation(
            foreground=person,
            signed_distance_px=signed_distance_px(person),
            decided_by_background=(like | unlike).astype(np.float32),
            band_m=(float(inwards), float(outwards)),
        )

    def _update_models(
        self,
        rgb: UInt8[np.ndarray, "height width 3"],
        segmentation: _Segmentation,
        alpha: Float32[np.ndarray, "height width"],
        camera: Camera,
        clothed: ClothedBody,
        shape: _ExpectedShape,
    ) -> None:
        """Learn the shape's error, the clothes and the background from a segmentation."""
        from_cut, per_m = segmentation.signed_distance_px, clothed.px_per_m
        rim = (from_cut > 0.0) & (from_cut < 1.2)
        deep = rim & (shape.signed_distance_px < 1.5 - segmentation.band_m[0] * per_m)
        too_deep = deep.sum() > MAX_INNER_LIMIT_FRACTION * max(rim.sum(), 1)
        wider = self._wider_m + (BAND_GROWTH_M if too_deep else -BAND_SHRINK_M)
        self._wider_m = float(np.clip(wider, 0.0, MAX_BAND_GROWTH_M))
        near = (np.abs(from_cut) < 0.8) & (
            np.abs(shape.signed_distance_px) < (segmentation.band_m[0] + 0.005) * per_m
        )
        if near.any():
            # The standard deviation of a normal error is 1.25 times its mean absolute value.
            off = 1.25 * float(np.abs(shape.signed_distance_px[near]).mean()) / per_m
            self._shape_error_m += 0.2 * (off - self._shape_error_m)
        self._clothing.update(
            clothed, camera, rgb, alpha, shape.signed_distance_px, segmentation.band_m
        )
        margin = max(BACKGROUND_GAP_PX, BACKGROUND_GAP_M * per_m)
        self._background.update(rgb, (from_cut > margin) & (shape.signed_distance_px > margin))

    def _shape_weight(
        self, segmentation: _Segmentation, shape: _ExpectedShape, clothed: ClothedBody
    ) -> Float32[np.ndarray, "height width"]:
        """Weight of the clothed shape in the mask: both count with their inverse variance.

        Segmentation and shape are usually `_shape_error_m` apart. What exceeds the segmentation's
        own error is the pose's, and so the shape's. Where they are farther apart, one is wrong: the
        segmentation, as far as clothes are known and poses are good. Where the background decided,
        and for hair that protrudes in one piece, the shape has no weight.
        """
        shell = max(self._shape_error_m**2 - CUT_ERROR_M**2, MIN_SHAPE_ERROR_M**2)
        shell += (UNKNOWN_SHAPE_ERROR_M * (1.0 - clothed.known_fraction)) ** 2
        trusted = clothed.known_fraction * CUT_ERROR_M**2 / (CUT_ERROR_M**2 + shell)
        apart = (segmentation.signed_distance_px - shape.signed_distance_px) / np.float32(
            clothed.px_per_m
        )
        leaked = np.maximum(apart**2 - np.float32(self._shape_error_m**2), np.float32(0.0))
        leaked[shape.hair_region & (apart < 0.0)] = 0.0
        beyond = segmentation.foreground & shape.hair_region & (shape.signed_distance_px > 0.0)
        shell = shell + (solid_hair(beyond, clothed.px_per_m) * np.float32(HAIR_BAND_M)) ** 2
        cut_off = np.float32(CUT_ERROR_M**2) + np.float32(trusted) * leaked
        return (
            cut_off
            / (cut_off + np.float32(shell))
            * (np.float32(1.0) - segmentation.decided_by_background)
        )


def _blend(
    alpha: Float32[np.ndarray, "height width"],
    weight: Float32[np.ndarray, "height width"],
    shape: _ExpectedShape,
    size_px: tuple[int, int],
) -> Float32[np.ndarray, "_ _"]:
    """Weighted mean of the shape's coverage and the segmentation's alpha, at any size."""
    covered = shape.coverage
    if alpha.shape[::-1] != size_px:
        smaller = alpha.shape[1] > size_px[0]
        way = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
        alpha, weight = (cv2.resize(each, size_px, interpolation=way) for each in (alpha, weight))
        finer = shape.supersampled.shape[1] >= size_px[0]
        way = cv2.INTER_AREA if finer else cv2.INTER_LINEAR
        covered = cv2.resize(shape.supersampled, size_px, interpolation=way)
    return weight * covered + (np.float32(1.0) - weight) * alpha

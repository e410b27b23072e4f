"""Masks without a segmenter: GrabCutSegmenter, seeded by the posed body and by what it was seen to wear.

GrabCutSegmenter (Rother et al. 2004) tells person from background by two mixtures of colours and by edges.
Alone it leaks into backgrounds of the person's colours; so the posed body, with the clothes that
earlier frames have shown on it (`ClothingOffset`), says where to look: only a narrow band around that shape
is in doubt. If the camera stands still, pixels that were background in earlier frames also say what
lies behind the person (`BackgroundModel`). The mask is the mean of cut and shape, weighted by how far they
were found to be off; where they are far apart though the poses are good, the cut has leaked. Last,
where it is known what lies behind, border pixels are split by colours (`refine_border`).

How large the picture is in which a mask is found.
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
from preprocess.masks.matting import border_distance_px, refine_border, soften_border

WORKING_PERSON_PX = 220
"""Masks are found in pictures in which the person is about so large, or smaller."""

UPSAMPLE_BELOW_PX = 150
"""Pictures of smaller persons are enlarged twice: masks then know parts of a pixel."""

DOWNSAMPLE_ABOVE = 1.1
"""A person who is little larger is not worth a smaller picture."""

JOINT_HEIGHT_FRACTION = 0.87
"""Of a standing person's height, how much lies between head joint and toes."""

RESCALE_RATIO = 1.4
"""The scale is chosen anew when the person has become so many times larger or smaller."""


@final
class WorkingResolution:
    """The scale for one person; it seldom changes."""

    def __init__(self, shaped: ShapedBody) -> None:
        """Nobody was seen yet."""
        self._shaped = shaped
        self._tall_px: float | None = None

    def scale_for(self, pose: BodyPose, camera: Camera) -> float:
        """How many times larger than the frame the picture is in which its mask is found."""
        joints = self._shaped.with_pose(pose).joints()
        depth = joints @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
        if depth.min() > 0.0:
            tall = float(np.ptp(camera.project(joints), axis=0).max()) / JOINT_HEIGHT_FRACTION
            before = self._tall_px
            if before is None or not 1.0 / RESCALE_RATIO < tall / before < RESCALE_RATIO:
                self._tall_px = tall
        tall = max(self._tall_px or 0.0, 1.0)
        if tall < UPSAMPLE_BELOW_PX:
            return 2.0
        return 1.0 if tall < DOWNSAMPLE_ABOVE * WORKING_PERSON_PX else WORKING_PERSON_PX / tall


UNKNOWN_BAND_M, KNOWN_BAND_M, MIN_OUTER_BAND_M = 0.02, 0.008, 0.012
"""How far inside and outside the shell pixels are in doubt, where nothing is known of it and where
everything is; outside at least the last, or nothing would ever grow."""

MAX_INNER_LIMIT_FRACTION = 0.1
"""Where more of the cut than this runs along the inner limit of what is in doubt, the pose is off
and the limits must be wider."""
BAND_GROWTH_M, BAND_SHRINK_M, MAX_BAND_GROWTH_M = 0.012, 0.002, 0.05
OUTER_GROWTH_RATIO = 1.5
"""By how much the limits follow from frame to frame; outside it counts so much more."""

BACKGROUND_MARGIN_M = 0.25
"""How much of the background is looked at."""

BACKGROUND_GAP_M, BACKGROUND_GAP_PX = 0.015, 2.0
"""Background is what is at least so far from the person, by both measures."""

ITERATIONS, FEWER_ITERATIONS = 2, 1
"""Rounds of GrabCutSegmenter; the fewer where the shell, and what lies behind it, are known."""

CUT_ERROR_M = 0.006
"""How far the cut's border is off, for whatever reason, where it has not leaked."""
MIN_SHAPE_ERROR_M, UNKNOWN_SHAPE_ERROR_M = 0.002, 0.012
"""How far the shell is off at the least, and how far as long as nothing is known of it."""

MIN_SHAPE_IOU = 0.4
"""Masks that agree less with the shell's shape (intersection over union) are not used."""


class _ExpectedShape(NamedTuple):
    """The shell in a picture.

    Attributes:
        fine: Its shape, finer than the picture.
        covered: How much of each pixel it covers.
        away: How far each pixel is outside of it, in pixels; inside negative.
        hair: Which pixels may be hair.
    """

    supersampled: Float32[np.ndarray, "rows columns"]
    coverage: Float32[np.ndarray, "height width"]
    signed_distance_px: Float32[np.ndarray, "height width"]
    hair_region: Bool[np.ndarray, "height width"]


class _Segmentation(NamedTuple):
    """What GrabCutSegmenter says about a picture.

    Attributes:
        person: Who is.
        away: How far each pixel is outside of the person, in pixels; inside negative.
        sure: Where what lies behind decided, 1, else 0.
        band_m: How far inside and outside the shell pixels were in doubt.
    """

    foreground: Bool[np.ndarray, "height width"]
    signed_distance_px: Float32[np.ndarray, "height width"]
    decided_by_background: Float32[np.ndarray, "height width"]
    band_m: tuple[float, float]


@final
class GrabCutSegmenter:
    """Masks of one person, frame by frame.

    Attributes:
        name: How the report calls it.
        found: How many masks were made.
        agreement: Their mean intersection over union with the shape of body and clothes that was
            expected; 0 of none.
    """

    name = "GrabCut"

    def __init__(self, shaped: ShapedBody) -> None:
        """Nothing is known about clothes and background yet."""
        self._shell, self._behind = ClothingOffset(shaped), BackgroundModel()
        self._colours = AppearanceModel(len(shaped.vertices))
        self._head = shaped.body.weights.argmax(axis=1) == HEAD_JOINT
        self._scale = WorkingResolution(shaped)
        self._wider_m = 0.0
        self._off_m = 0.012
        self.mask_count, self.agreement = 0, 0.0

    def __call__(
        self, frame: Frame, pose: BodyPose, camera: Camera
    ) -> Float32[np.ndarray, "height width"]:
        """The mask of a picture; see `Segmenter`.

        Raises:
            InputError: If the body is not in the picture, or nothing that agrees with it is found.
        """
        scale = self._scale.scale_for(pose, camera)
        size_px = (max(1, round(frame.size_px[0] * scale)), max(1, round(frame.size_px[1] * scale)))
        small, rgb = camera.resize(size_px), frame.rgb
        if size_px != frame.size_px:
            way = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
            rgb = cv2.resize(rgb, size_px, interpolation=way)
        around, shape = self._expected_shape(pose, small)
        self._behind.reset_if_moved(
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

    def _refine_border(
        self,
        rgb: UInt8[np.ndarray, "height width 3"],
        alpha: Float32[np.ndarray, "height width"],
        clothed: ClothedBody,
        camera: Camera,
    ) -> Float32[np.ndarray, "height width"]:
        """The mask with its border where colours put it, if it is known what lies behind."""
        outside = border_distance_px(alpha)
        behind = self._behind.predict(rgb, outside > BACKGROUND_GAP_PX)
        if behind is None:
            return alpha
        sight = VertexVisibility.of(clothed, camera)
        self._colours.update(sight, rgb, -outside)
        person = self._colours.predict(sight, camera.size_px)
        return refine_border(rgb, alpha, behind, person)

    def _expected_shape(self, pose: BodyPose, camera: Camera) -> tuple[ClothedBody, _ExpectedShape]:
        around = self._shell.clothe(pose, camera)
        if around is None:
            raise InputError("the posed body is not in the picture")
        fine = self._shell.draw(around, camera)
        covered = cv2.resize(fine, camera.size_px, interpolation=cv2.INTER_AREA)
        hair = head_region(around.skin[self._head], camera, around.px_per_m)
        shape = _ExpectedShape(
            supersampled=fine,
            coverage=covered,
            signed_distance_px=signed_distance_px(covered > 0.5),
            hair_region=hair,
        )
        if (shape.signed_distance_px < 0.0).sum() < 16:
            raise InputError("the posed body is not in the picture")
        return around, shape

    def _segment(
        self, rgb: UInt8[np.ndarray, "height width 3"], clothed: ClothedBody, shape: _ExpectedShape
    ) -> _Segmentation:
        """Who is person, among the pixels that the shell leaves in doubt."""
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
        like, unlike = self._behind.classify(rgb, doubtful)
        labels[like], labels[unlike] = cv2.GC_PR_BGD, cv2.GC_PR_FGD
        labels[away <= -inwards] = cv2.GC_FGD
        settled = self._behind.is_initialized and clothed.known_fraction > OVERSHOOT_KNOWN_FRACTION
        rounds = FEWER_ITERATIONS if settled else ITERATIONS
        margin = int(BACKGROUND_MARGIN_M * clothed.px_per_m) + 1
        rows, columns = np.nonzero(near)
        box = (
            slice(max(0, int(rows.min()) - margin), int(rows.max()) + margin + 1),
            slice(max(0, int(columns.min()) - margin), int(columns.max()) + margin + 1),
        )
        part = np.ascontiguousarray(labels[box])
        models = np.zeros((1, 65)), np.zeros((1, 65))
        if (part & 1).any() and not (part & 1).all():
            cv2.setRNGSeed(0)
            bgr = np.ascontiguousarray(rgb[box][..., ::-1])
            cv2.grabCut(bgr, part, (0, 0, 1, 1), *models, rounds, cv2.GC_INIT_WITH_MASK)
        person = np.zeros(away.shape, dtype=bool)
        person[box] = (part & 1) > 0
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
        """How far poses are off, what the person wears, and what lies behind."""
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
            # the standard deviation of a normal error is 1.25 times its mean
            off = 1.25 * float(np.abs(shape.signed_distance_px[near]).mean()) / per_m
            self._off_m += 0.2 * (off - self._off_m)
        self._shell.update(
            clothed, camera, rgb, alpha, shape.signed_distance_px, segmentation.band_m
        )
        margin = max(BACKGROUND_GAP_PX, BACKGROUND_GAP_M * per_m)
        self._behind.update(rgb, (from_cut > margin) & (shape.signed_distance_px > margin))

    def _shape_weight(
        self, segmentation: _Segmentation, shape: _ExpectedShape, clothed: ClothedBody
    ) -> Float32[np.ndarray, "height width"]:
        """The shell's share of the mask: both count with the inverse of their variance.

        Cut and shell are usually `_off_m` apart. What that is more than the cut's own error is the
        pose's, and so the shell's. Where they are farther apart than that, one of them is wrong:
        the cut, as far as the shell is known and the poses are good. Where what lies behind
        decided, and about hair that stands off in one piece, the shell has no say.
        """
        shell = max(self._off_m**2 - CUT_ERROR_M**2, MIN_SHAPE_ERROR_M**2)
        shell += (UNKNOWN_SHAPE_ERROR_M * (1.0 - clothed.known_fraction)) ** 2
        trusted = clothed.known_fraction * CUT_ERROR_M**2 / (CUT_ERROR_M**2 + shell)
        apart = (segmentation.signed_distance_px - shape.signed_distance_px) / np.float32(
            clothed.px_per_m
        )
        leaked = np.maximum(apart**2 - np.float32(self._off_m**2), np.float32(0.0))
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
    """The mean of the cut's alpha and what the shell covers, of so much weight, of a size."""
    covered = shape.coverage
    if alpha.shape[::-1] != size_px:
        smaller = alpha.shape[1] > size_px[0]
        way = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
        alpha, weight = (cv2.resize(each, size_px, interpolation=way) for each in (alpha, weight))
        finer = shape.supersampled.shape[1] >= size_px[0]
        way = cv2.INTER_AREA if finer else cv2.INTER_LINEAR
        covered = cv2.resize(shape.supersampled, size_px, interpolation=way)
    return weight * covered + (np.float32(1.0) - weight) * alpha

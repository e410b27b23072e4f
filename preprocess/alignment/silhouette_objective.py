"""The silhouette objective: IoU of posed bodies with the small masks of a few frames."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from capture.input_error import InputError
from capture.source import AlphaMask, Frame, FrameSource
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.body.body_pose import Motion
from preprocess.body.body_surface import (
    SILHOUETTE_PERSON_PX,
    SkinPoints,
    soft_iou,
    splat_silhouette,
)
from preprocess.cameras.camera_file import CameraTrack
from preprocess.masks.mask_sources import MaskSource
from preprocess.observation import associate_cameras
from preprocess.tracking.keypoints import KeypointTrack

GOOD_IOU = 0.7
"""Mean IoU of body and masks from which a capture is good."""
USABLE_IOU = 0.5
"""Mean IoU below which a capture cannot be trained on."""
SAMPLED_FRAMES = 16
"""Number of frames that are sampled."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MaskSample:
    """One frame's reduced mask, in [0, 1], and the row of the frame's camera.

    `picture` is the frame, reduced like those of training, if it was decoded and is to be kept.
    """

    index: int
    camera_row: int
    alpha: AlphaMask
    picture: Frame | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class SilhouetteObjective:
    """Scores a geometry by the IoU of the posed body with the masks of a few frames.

    `samples` are in the frames' order and of one size; `rejections` say why other masks cannot be
    used.
    """

    samples: tuple[MaskSample, ...]
    skin: SkinPoints
    rejections: tuple[str, ...] = ()
    _posed_cache: dict[tuple[Motion, int], Float32[np.ndarray, "points 3"]] = field(
        default_factory=dict
    )

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the reduced masks."""
        height, width = self.samples[0].alpha.shape
        return int(width), int(height)

    @property
    def are_boxes(self) -> bool:
        """True if masks fill their boxes as no person does: they do not tell the person's size."""
        return float(np.median([_box_fill(w.alpha > 0.5) for w in self.samples])) > 0.95

    def subset(self, count: int) -> "SilhouetteObjective":
        """At most `count` of the frames, evenly spaced."""
        rows = spaced_indices(len(self.samples), count)
        return replace(self, samples=tuple(self.samples[r] for r in rows))

    def frame_scores(self, geometry: CaptureGeometry) -> Float[np.ndarray, "samples"]:
        """IoU of each frame; NaN where the geometry has no pose."""
        return np.array([self.frame_score(geometry, sample) for sample in self.samples])

    def frame_score(self, geometry: CaptureGeometry, sample: MaskSample) -> float:
        """IoU of one frame; NaN if the geometry has no pose."""
        row = geometry.row_for_frame(sample.index)
        if row is None:
            return float("nan")
        camera = geometry.camera_at(sample.camera_row, self.size_px)
        alpha = 1.0 - sample.alpha if geometry.masks_inverted else sample.alpha
        drawn = splat_silhouette(self.posed_points(geometry.motion, row), camera)
        return soft_iou(
            drawn, components_touching(alpha, drawn) if geometry.keeps_person_only else alpha
        )

    def keep_person(self, geometry: CaptureGeometry, frame: int, alpha: AlphaMask) -> AlphaMask:
        """The components of a frame's mask, of any size, that the posed body touches.

        Unchanged where the geometry has no pose for the frame.
        """
        row = geometry.row_for_frame(frame)
        if row is None:
            return alpha
        camera = geometry.camera_at(int(geometry.camera_rows()[row]), self.size_px)
        drawn = splat_silhouette(self.posed_points(geometry.motion, row), camera).astype(np.uint8)
        large = cv2.resize(drawn, alpha.shape[1::-1], interpolation=cv2.INTER_NEAREST)
        return components_touching(alpha, large > 0)

    def posed_points(self, motion: Motion, row: int) -> Float32[np.ndarray, "points 3"]:
        """The skin in one of a motion's poses; cached, as candidates share poses."""
        if (motion, row) not in self._posed_cache:
            if len(self._posed_cache) >= 256:  # 25 MB
                self._posed_cache.clear()
            self._posed_cache[motion, row] = self.skin.posed(motion[row])
        return self._posed_cache[motion, row]


def mean_score(scores: Float[np.ndarray, "samples"]) -> float:
    """Mean score of the frames that have a pose; 0 if none has."""
    known = scores[np.isfinite(scores)]
    return float(known.mean()) if len(known) else 0.0


def mean_with_missing(scores: Float[np.ndarray, "samples"]) -> float:
    """Mean score; where more than half of the frames lack a pose, those count as 0."""
    if 2 * np.isfinite(scores).sum() >= len(scores):
        return mean_score(scores)
    return float(np.nansum(scores)) / len(scores)


def components_touching(alpha: AlphaMask, body: Bool[np.ndarray, "height width"]) -> AlphaMask:
    """The connected components of a mask that a body covers in part; the others become 0.

    Unchanged where the body touches none.
    """
    count, labels = cv2.connectedComponents((alpha > 0.1).astype(np.uint8), connectivity=8)
    covered = np.bincount(labels[body], minlength=count)
    areas = np.bincount(labels.ravel(), minlength=count)
    own = covered > 0.1 * areas
    own[0] = False
    if not own.any():
        return alpha
    return np.where(np.isin(labels, np.flatnonzero(own)), alpha, 0.0)


def _box_fill(alpha: Bool[np.ndarray, "height width"]) -> float:
    """Fraction of its bounding box that a mask covers."""
    rows, columns = np.flatnonzero(alpha.any(axis=1)), np.flatnonzero(alpha.any(axis=0))
    if not len(rows):
        return 0.0
    return float(alpha[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].mean())


def spaced_indices(total: int, count: int) -> list[int]:
    """At most `count` indices below `total`, evenly spaced, without the ends."""
    count = min(count, total)
    return [int((place + 0.5) / count * total) for place in range(count)]


def sample_masks(
    source: FrameSource,
    masks: MaskSource,
    cameras: CameraTrack,
    skin: SkinPoints,
    *,
    count: int = SAMPLED_FRAMES,
    person_px: int = SILHOUETTE_PERSON_PX,
    track: KeypointTrack | None = None,
) -> SilhouetteObjective:
    """Read a few given masks; images are decoded only where their alpha channel is the mask.

    `person_px` is the height of the person in the reduced masks. Masks are those of frames with key
    points in `track`, if there is one: a file may claim more frames than can be decoded.
    """
    start, step = source.selection.start, source.selection.step
    usable = [start + step * n for n in range(source.frame_count or 1)]
    if track is not None:
        usable = [int(n) for n in track.frames if source.selection.contains(int(n))] or usable
    usable = [frame for frame in usable if frame not in cameras.frames_without_camera] or usable
    frames = [usable[n] for n in spaced_indices(len(usable), count)]
    size_px = _scaled_size(source.size_px, longer=256.0)
    camera_row = associate_cameras(cameras, source)
    masks.check()
    samples, refused = list[MaskSample](), list[str]()
    for index in frames:
        try:
            alpha = masks.read(index, size_px)
        except InputError as cause:
            refused.append(str(cause))
            continue
        if (alpha > 0.5).any():
            samples.append(MaskSample(index=index, camera_row=camera_row(index), alpha=alpha))
    if not samples:
        raise InputError(
            f"None of the masks of {len(frames)} frames of {source.path} shows a person."
        )
    samples = reduce_masks(samples, source.size_px, person_px)
    return SilhouetteObjective(samples=samples, skin=skin, rejections=tuple(refused))


def reduce_masks(
    samples: Sequence[MaskSample], full_px: tuple[int, int], person_px: int
) -> tuple[MaskSample, ...]:
    """Bring masks of one size to one in which the person is about `person_px` high.

    Each mask shows a person; `full_px` is the width and height of the frames.
    """
    rows = [np.flatnonzero((each.alpha > 0.5).any(axis=1)) for each in samples]
    tall = float(np.median([np.ptp(each) + 1 for each in rows]))
    longer = max(samples[0].alpha.shape) * person_px / max(tall, 1.0)
    small = _scaled_size(full_px, min(longer, 4.0 * person_px))
    return tuple(replace(each, alpha=_resize_alpha(each.alpha, small)) for each in samples)


def _scaled_size(size_px: tuple[int, int], longer: float) -> tuple[int, int]:
    scale = min(1.0, longer / max(size_px))
    return max(8, round(size_px[0] * scale)), max(8, round(size_px[1] * scale))


def _resize_alpha(alpha: Float32[np.ndarray, "_ _"], size_px: tuple[int, int]) -> AlphaMask:
    shrinks = alpha.shape[1] >= size_px[0]
    return np.asarray(
        cv2.resize(alpha, size_px, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR),
        dtype=np.float32,
    )


def mask_warnings(objective: SilhouetteObjective | None, height_px: int) -> Iterator[str]:
    """Describe what is implausible in masks, for people; `height_px` is that of the images."""
    if objective is None:
        return
    looked = len(objective.rejections) + len(objective.samples)
    if objective.rejections:
        first = objective.rejections[0].rstrip(".")
        yield (
            f"{len(objective.rejections)} of {looked} sampled masks cannot be used, and "
            f"their frames are left out ({first})."
        )
    if objective.are_boxes:
        yield (
            "The masks are boxes, not outlines: all that is in them will be learnt as the person. "
            "Leave them out (--masks segmenter:blazepose), or give a segmenter's."
        )
    alphas = [sample.alpha > 0.5 for sample in objective.samples]
    touching = sum(a[0].any() or a[:, 0].any() or a[:, -1].any() or a[-1].any() for a in alphas)
    if touching > 0.2 * len(alphas):
        yield (
            f"In {touching} of {len(alphas)} frames the person touches the image's border; what is "
            "outside cannot be learnt."
        )
    heights = [np.ptp(np.flatnonzero(a.any(axis=1))) + 1 for a in alphas]
    tall = float(np.median(heights)) / alphas[0].shape[0] * height_px
    if tall < 60:
        yield f"The person is {tall:.0f} px high; little detail can be learnt from that."

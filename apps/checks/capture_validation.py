"""Validation of a capture: sanity of its numbers, IoU of body and masks, corrections."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32

from capture.camera import same_aspect_ratio
from capture.input_error import InputError
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.correction_search import (
    GOOD_IOU,
    USABLE_IOU,
    CorrectionResult,
    find_corrections,
    needs_video_correction,
)
from preprocess.alignment.corrections import undo_pose_delay
from preprocess.alignment.edge_objective import (
    MAX_DECODED_FRAMES,
    SAMPLED_IMAGES,
    EdgeObjective,
    sample_images,
)
from preprocess.alignment.image_alignment import edge_contrast, sample_video
from preprocess.alignment.sanity_checks import sanity_warnings
from preprocess.alignment.silhouette_objective import (
    SAMPLED_FRAMES,
    SilhouetteObjective,
    mean_score,
    sample_masks,
)
from preprocess.body.body_surface import SkinPoints
from preprocess.capture_session import Capture, CaptureInputs
from preprocess.masks.mask_files import Masks
from preprocess.observation import associate_cameras, associate_masks
from preprocess.open_capture import open_capture
from preprocess.poses.plausibility import implausibility_reason

QUICK_FRAMES = 8
"""Frames checked before a run starts."""
QUICK_FILM_FRAMES = 96
"""Frames at the start of the video from which its checked images are taken."""
GOOD_EDGE_RATIO = 2.0
"""Least ratio of edge strength across and beside the body's outline where poses match."""
NO_KNOWN_MISTAKE = (
    "No known mistake explains this. Poses or masks may belong to another video or person, or "
    "tracking may have failed. Recompute them from this video."
)
"""Diagnosis if no correction helps."""
MIN_EXCESS = 1.3
"""Area of masks by the body's from which they hold more than the person."""
MIN_COVERED = 0.85
"""Share of the body that such masks cover."""
QUICK_OFFSETS = (1, 2)
"""Delays of the poses, in frames, that are tested even if poses and masks match."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptureValidation:
    """Outcome of validating a capture.

    Attributes:
        recording: The capture.
        hypothesis: Its poses and cameras as stored.
        sampled_masks: Masks of some frames; None without masks.
        diagnosis: Corrections tested and found; None without masks.
        refusal: Why ia-ingest would refuse the capture; None if it would not.
        anomalies: Sentences about implausible numbers.
        mask_iou: Mean IoU of body and masks as ia-ingest would read them; None without masks.
        edge_ratio: Ratio of edge strength across and beside the body's outline; None with masks, or
            if no image can be decoded.
    """

    recording: Capture
    hypothesis: CaptureGeometry
    sampled_masks: SilhouetteObjective | None
    diagnosis: CorrectionResult | None
    refusal: str | None
    anomalies: tuple[str, ...]
    mask_iou: float | None
    edge_ratio: float | None = None

    @property
    def causes(self) -> tuple[str, ...]:
        """Names of the mistakes found, most important first."""
        cures = self.diagnosis.corrections if self.diagnosis else ()
        return tuple(dict.fromkeys(cure.cause for cure in cures))

    @property
    def verdict(self) -> str:
        """Verdict: `good`, `warn` or `unusable`."""
        if self.refusal is not None or (self.mask_iou is not None and self.mask_iou < USABLE_IOU):
            return "unusable"
        well = self.mask_iou is not None and self.mask_iou >= GOOD_IOU
        well = well and (not self.causes or self.is_auto_corrected)
        well |= self.edge_ratio is not None and self.edge_ratio >= GOOD_EDGE_RATIO
        return "good" if well and not self.anomalies else "warn"

    @property
    def unexplained(self) -> str:
        """What may be wrong if no correction helps."""
        if self.sampled_masks is None or self.sampled_masks.are_boxes:
            return NO_KNOWN_MISTAKE
        covered, areas = self.sampled_masks.excess(self.hypothesis)
        if covered < MIN_COVERED or areas < MIN_EXCESS:
            return NO_KNOWN_MISTAKE
        return (
            f"The masks show {areas:.1f} times the body's area, and the body lies within them: "
            "another person or a thing that touches this person is in the masks, or clothes are "
            "very wide. Give masks of this person alone (--masks)."
        )

    @property
    def is_auto_corrected(self) -> bool:
        """Whether ia-ingest corrects everything that is wrong automatically."""
        masks = self.recording.masks
        return self.causes == ("mask_polarity",) and masks is not None and masks.inverted

    @property
    def has_film_errors(self) -> bool:
        """Whether a mistake was found in the images alone."""
        return any(cause.startswith("video_") for cause in self.causes)

    @property
    def expected_improvement(self) -> str:
        """Sentence on the scores after correction; empty without causes."""
        if self.diagnosis is None or not self.causes:
            return ""
        scores = []
        if not all(cause.startswith("video_") for cause in self.causes):
            scores.append(f"IoU after correction: {self.corrected_iou:.2f}")
        if self.has_film_errors and self.diagnosis.video is not None:
            film = self.diagnosis.video
            before = f" instead of {film.score_before:.2f}" if film.score_before > 0.0 else ""
            scores.append(
                f"Mask outlines on image edges: {film.score_after:.2f}{before} (0.5 is chance)"
            )
        return f"{'. '.join(scores)}."

    @property
    def stored_iou(self) -> float:
        """IoU of body and masks as stored; NaN without masks."""
        return self.diagnosis.iou_before if self.diagnosis else float("nan")

    @property
    def corrected_iou(self) -> float:
        """IoU of body and masks after all corrections; NaN without masks."""
        return self.diagnosis.iou_after if self.diagnosis else float("nan")


def check_capture(inputs: CaptureInputs) -> CaptureValidation:
    """Open a capture and validate it; few frames are decoded.

    Raises:
        InputError: If a part is missing or unreadable.
    """
    try:
        return check_opened_capture(*_open_inputs(inputs))
    except InputError as error:
        found = _check_transposed(inputs, str(error))
        if found is None:
            raise
        return found


def _check_transposed(inputs: CaptureInputs, refusal: str) -> CaptureValidation | None:
    """Validate the capture with its video rotated; None if that explains nothing."""
    try:
        recording = open_capture(replace(inputs, transposed=True), skip_checks=True)
        found = check_opened_capture(recording, refusal)
    except InputError:
        return None
    return found if found.has_film_errors else None


def check_opened_capture(
    recording: Capture, polarity_error: str | None = None
) -> CaptureValidation:
    """Validate an opened capture.

    Args:
        recording: The capture.
        polarity_error: Why the masks' polarity is unknown; None if it is known.

    Raises:
        InputError: If a part is unreadable.
    """
    hypothesis, refused = (
        _stored_hypothesis(recording),
        implausibility_reason(recording.motion) or polarity_error,
    )
    try:
        recording.check()
    except InputError as error:
        refused = refused or str(error)
    masked = recording.masks is not None or recording.source.has_alpha
    evidence = _sample_masks(recording) if masked else None
    count = recording.source.frame_count or len(recording.motion)
    selection = recording.source.selection
    frames = [selection.start + selection.step * number for number in range(count)]
    diagnosis = agreed = None
    if evidence is not None:
        diagnosis = find_corrections(hypothesis, evidence, count, _sample_film(recording, evidence))
        agreed = mean_score(evidence.frame_scores(replace(hypothesis, masks_inverted=False)))
    odd = sanity_warnings(hypothesis, frames, evidence, recording.source.size_px[1])
    return CaptureValidation(
        recording=recording, hypothesis=hypothesis, sampled_masks=evidence, diagnosis=diagnosis,
        refusal=refused, anomalies=tuple(odd), mask_iou=agreed,
        edge_ratio=None if masked or refused else _edge_ratio(recording, hypothesis),
    )  # fmt: skip


def passes_quick_check(recording: Capture) -> bool:
    """Check a few masks and images within a few hundredths of a second.

    Poses that are one or two frames late are detected as well.
    """
    if recording.live is not None or not (recording.masks or recording.source.has_alpha):
        return True  # nothing to compare with
    try:
        evidence = _sample_masks(recording, QUICK_FRAMES)
    except InputError:  # these masks are empty; reading all of them reports that
        return True
    hypothesis = replace(_stored_hypothesis(recording), masks_inverted=False)
    now = mean_score(evidence.frame_scores(hypothesis))
    shifts = [
        mean_score(evidence.frame_scores(undo_pose_delay(k).apply(hypothesis)))
        for n in QUICK_OFFSETS
        for k in (n, -n)
    ]
    if now < GOOD_IOU or now < max(shifts):
        return False
    film = (
        None
        if evidence.are_boxes
        else _sample_film(recording, evidence, QUICK_FRAMES, QUICK_FILM_FRAMES)
    )
    return film is None or not needs_video_correction(
        hypothesis, film, recording.source.frame_count or 1
    )


def _edge_ratio(recording: Capture, hypothesis: CaptureGeometry) -> float | None:
    """Return the edge ratio along the body's outline; None if no image can be decoded."""
    skin = SkinPoints.of(recording.shaped)
    try:
        return edge_contrast(
            hypothesis, skin, sample_video(hypothesis, skin, recording.cameras, recording.source)
        )
    except InputError:
        return None


def _sample_film(
    recording: Capture,
    evidence: SilhouetteObjective,
    count: int = SAMPLED_IMAGES,
    within: int = MAX_DECODED_FRAMES,
) -> EdgeObjective | None:
    """Sample images with all masks; None if the masks are the images' alpha."""
    masks = recording.masks
    if masks is None:
        return None
    return sample_images(
        recording.source, mask_lookup(recording, masks, evidence.size_px), masks.count,
        evidence.size_px, count=count, within=within,
    )  # fmt: skip


def mask_lookup(
    recording: Capture, masks: Masks, size_px: tuple[int, int]
) -> Callable[[int], Float32[np.ndarray, "height width"]]:
    """Return a function from a frame number, also beyond the video's, to its mask.

    The function raises InputError where there is no such mask.
    """
    row_of = _mask_row_lookup(recording)

    def alpha(number: int) -> Float32[np.ndarray, "height width"]:
        row = row_of(number)
        if not 0 <= row < masks.count:
            raise InputError(f"There is no mask for frame {number} in {masks.path}.")
        return masks.alpha(row, size_px)

    return alpha


def _mask_row_lookup(recording: Capture) -> Callable[[int], int]:
    """Return a function from a frame number to its mask; in order if counts differ.

    Raises:
        InputError: If masks and video have different aspect ratios.
    """
    try:
        return associate_masks(recording.masks, recording.source)
    except InputError:
        masks = recording.masks
        if masks is None or not same_aspect_ratio(masks.size_px, recording.source.size_px):
            raise
        path, count = masks.path, masks.count

    def in_order(index: int) -> int:
        if index >= count:
            raise InputError(f"There is no mask for frame {index} in {path}.")
        return index

    return in_order


def _sample_masks(recording: Capture, count: int = SAMPLED_FRAMES) -> SilhouetteObjective:
    mask_row = _mask_row_lookup(recording)
    camera_row = associate_cameras(recording.cameras, recording.source)
    return sample_masks(
        recording.source, recording.masks, mask_row, camera_row, SkinPoints.of(recording.shaped),
        count=count, excluded_frames=recording.cameras.frames_without_camera,
    )  # fmt: skip


def _stored_hypothesis(recording: Capture) -> CaptureGeometry:
    """Return poses, cameras and mask polarity as stored in the files."""
    hypothesis = CaptureGeometry.of(recording.motion, recording.cameras, recording.source)
    turned = recording.masks is not None and recording.masks.inverted
    return replace(hypothesis, masks_inverted=turned)


def _open_inputs(inputs: CaptureInputs) -> tuple[Capture, str | None]:
    """Open the capture; also return why the masks' polarity is unknown, if it is."""
    try:
        return open_capture(inputs, skip_checks=True), None
    except InputError as error:
        if inputs.invert_masks is not None:
            raise
        recording = open_capture(replace(inputs, invert_masks=False), skip_checks=True)
        return recording, str(error)


def json_number(value: float | None) -> float | None:
    """Round a number for JSON; NaN and infinity become null."""
    return None if value is None or not np.isfinite(value) else round(float(value), 4)

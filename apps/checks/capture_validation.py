"""A capture examined: what is odd in its numbers, how body and masks agree, what would mend it."""

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
from preprocess.body.silhouette import SkinPoints
from preprocess.capture_session import Capture, CaptureInputs
from preprocess.masks.mask_files import Masks
from preprocess.observe import associate_cameras, associate_masks
from preprocess.open_capture import open_capture
from preprocess.poses.plausibility import implausibility_reason

QUICK_FRAMES = 8
"""Frames that are looked at before a run begins."""
QUICK_FILM_FRAMES = 96
"""Frames of the film's beginning among which its pictures are then looked at."""
GOOD_EDGE_RATIO = 2.0
"""Least ratio of the edges across the body's outline to those beside it, if poses fit."""
NO_KNOWN_MISTAKE = (
    "None of the usual mistakes explains it. Are the poses or the masks of another video or "
    "person, or did the tracker lose the person? Make them again from this video."
)
QUICK_OFFSETS = (1, 2)
"""Offsets of the poses, in frames, that are tried even where all seems well."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptureValidation:
    """What the doctor found.

    Attributes:
        recording: The capture.
        claim: Its poses and cameras as they are.
        evidence: Masks of some frames; None where there are no masks to hold a body against.
        diagnosis: What was tried; None without masks.
        refused: Why a run would not even begin, if it would not.
        odd: Sentences about what is strange in the numbers.
        agreed: Mean agreement as a run would read the files; None without masks.
        edges: Without masks: how many times as strong the pictures' edges are across the body's
            outline as beside it; None with masks, or if no picture can be looked at.
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
        """Names of the mistakes found, the one that matters most first."""
        cures = self.diagnosis.corrections if self.diagnosis else ()
        return tuple(dict.fromkeys(cure.cause for cure in cures))

    @property
    def verdict(self) -> str:
        """`good`, `warning`, or `unusable`."""
        if self.refusal is not None or (self.mask_iou is not None and self.mask_iou < USABLE_IOU):
            return "unusable"
        well = self.mask_iou is not None and self.mask_iou >= GOOD_IOU
        well = well and (not self.causes or self.is_auto_corrected)
        well |= self.edge_ratio is not None and self.edge_ratio >= GOOD_EDGE_RATIO
        return "good" if well and not self.anomalies else "warn"

    @property
    def is_auto_corrected(self) -> bool:
        """Whether all that is wrong is what ia-ingest corrects without being asked."""
        masks = self.recording.masks
        return self.causes == ("mask_polarity",) and masks is not None and masks.inverted

    @property
    def has_film_errors(self) -> bool:
        """Whether a mistake was found that concerns the pictures alone."""
        return any(cause.startswith("video_") for cause in self.causes)

    @property
    def expected_improvement(self) -> str:
        """What correcting the named mistakes would bring, for people; empty without masks."""
        if self.diagnosis is None or not self.causes:
            return ""
        told = []
        if not all(cause.startswith("video_") for cause in self.causes):
            told.append(f"body and masks would agree by {self.corrected_iou:.2f}")
        if self.has_film_errors and self.diagnosis.video is not None:
            film = self.diagnosis.video
            before = f" instead of {film.score_before:.2f}" if film.score_before > 0.0 else ""
            told.append(
                f"the masks' outlines would score {film.score_after:.2f}{before} on the pictures' edges "
                "(0.5 is chance)"
            )
        return f"Once corrected, {', and '.join(told)}."

    @property
    def stored_iou(self) -> float:
        """Agreement of the files as they are stored; NaN without masks."""
        return self.diagnosis.iou_before if self.diagnosis else float("nan")

    @property
    def corrected_iou(self) -> float:
        """Agreement with all cures; NaN without masks."""
        return self.diagnosis.iou_after if self.diagnosis else float("nan")


def check_capture(inputs: CaptureInputs) -> CaptureValidation:
    """Opens a capture and looks at it; nothing is trained and hardly a frame is decoded.

    Raises:
        InputError: If a part is missing or unreadable, so that there is nothing to examine.
    """
    try:
        return check_opened_capture(*_open_inputs(inputs))
    except InputError as error:
        found = _check_transposed(inputs, str(error))
        if found is None:
            raise
        return found


def _check_transposed(inputs: CaptureInputs, refusal: str) -> CaptureValidation | None:
    """What is found if the film was rotated by a quarter turn; None if that explains nothing."""
    try:
        recording = open_capture(replace(inputs, transposed=True), skip_checks=True)
        found = check_opened_capture(recording, refusal)
    except InputError:
        return None
    return found if found.has_film_errors else None


def check_opened_capture(
    recording: Capture, polarity_error: str | None = None
) -> CaptureValidation:
    """The same for a capture that is open already.

    Args:
        recording: The capture.
        undecided: Why nobody knows which side of the masks is the person, if so.

    Raises:
        InputError: If a part is unreadable, so that there is nothing to examine.
    """
    claim, refused = (
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
        diagnosis = find_corrections(claim, evidence, count, _sample_film(recording, evidence))
        agreed = mean_score(evidence.frame_scores(replace(claim, masks_inverted=False)))
    odd = sanity_warnings(claim, frames, evidence, recording.source.size_px[1])
    return CaptureValidation(
        recording=recording, hypothesis=claim, sampled_masks=evidence, diagnosis=diagnosis,
        refusal=refused, anomalies=tuple(odd), mask_iou=agreed,
        edge_ratio=None if masked or refused else _edge_ratio(recording, claim),
    )  # fmt: skip


def passes_quick_check(recording: Capture) -> bool:
    """A glance at a few masks, in a few hundredths of a second: whether there is nothing to say.

    Poses that are a frame or two late are noticed, too.
    """
    if recording.live is not None or not (recording.masks or recording.source.has_alpha):
        return True  # what is not there cannot be looked at
    try:
        evidence = _sample_masks(recording, QUICK_FRAMES)
    except InputError:  # nobody in these few; whoever reads all of them will say so
        return True
    claim = replace(_stored_hypothesis(recording), masks_inverted=False)
    now = mean_score(evidence.frame_scores(claim))
    shifts = [
        mean_score(evidence.frame_scores(undo_pose_delay(k).apply(claim)))
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
        claim, film, recording.source.frame_count or 1
    )


def _edge_ratio(recording: Capture, claim: CaptureGeometry) -> float | None:
    """How the body's outline runs along the pictures' edges; None if none can be looked at."""
    skin = SkinPoints.of(recording.shaped)
    try:
        return edge_contrast(
            claim, skin, sample_video(claim, skin, recording.cameras, recording.source)
        )
    except InputError:
        return None


def _sample_film(
    recording: Capture,
    evidence: SilhouetteObjective,
    count: int = SAMPLED_IMAGES,
    within: int = MAX_DECODED_FRAMES,
) -> EdgeObjective | None:
    """Some pictures and all masks; None where the masks lie in the pictures themselves."""
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
    """From a frame's number, which may be beyond the film's, to its mask of a given size.

    What is returned raises InputError where there is no such mask.
    """
    row_of = _mask_row_lookup(recording)

    def alpha(number: int) -> Float32[np.ndarray, "height width"]:
        row = row_of(number)
        if not 0 <= row < masks.count:
            raise InputError(f"There is no mask for frame {number} in {masks.path}.")
        return masks.alpha(row, size_px)

    return alpha


def _mask_row_lookup(recording: Capture) -> Callable[[int], int]:
    """From a frame's number to its mask; in order where there is not one mask for each frame.

    Raises:
        InputError: If they are of another shape.
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
    """As the files say; masks that are turned while they are read were claimed the other way."""
    claim = CaptureGeometry.of(recording.motion, recording.cameras, recording.source)
    turned = recording.masks is not None and recording.masks.inverted
    return replace(claim, masks_inverted=turned)


def _open_inputs(inputs: CaptureInputs) -> tuple[Capture, str | None]:
    """The capture, and why a run would refuse its masks if it cannot tell which side is whom."""
    try:
        return open_capture(inputs, skip_checks=True), None
    except InputError as error:
        if inputs.invert_masks is not None:
            raise
        recording = open_capture(replace(inputs, invert_masks=False), skip_checks=True)
        return recording, str(error)


def json_number(value: float | None) -> float | None:
    """A number for JSON, which knows no NaN."""
    return None if value is None or not np.isfinite(value) else round(float(value), 4)

"""Validation of a capture, for ia-check, and in part before a run starts: IoU, mistakes, advice."""

from contextlib import suppress
from dataclasses import dataclass, replace

from capture.input_error import InputError, quote_command
from instant_avatar.cli.console import Console
from instant_avatar.cli.shared_options import (
    capture_name,
    format_frame_range,
    option_words,
    unused_path,
)
from preprocess.alignment.capture_geometry import CaptureGeometry, sanity_warnings
from preprocess.alignment.correction_search import (
    MIN_GAIN,
    CaptureObjective,
    CorrectionResult,
    CorrectionSearch,
)
from preprocess.alignment.corrections import undo_pose_delay
from preprocess.alignment.keypoint_objective import KeypointObjective, TrackedImage, track_images
from preprocess.alignment.silhouette_objective import (
    GOOD_IOU,
    SAMPLED_FRAMES,
    USABLE_IOU,
    SilhouetteObjective,
    mask_warnings,
    mean_score,
    sample_masks,
)
from preprocess.body.body_surface import SkinPoints
from preprocess.capture_inputs import CaptureInputs
from preprocess.capture_session import Capture
from preprocess.masks.mask_files import Masks
from preprocess.masks.mask_sources import StoredMasks
from preprocess.open_capture import ImportedCapture, align_capture
from preprocess.poses.plausibility import implausibility_reason

GOOD_KEYPOINT_SCORE = 0.5
"""Score of the key points from which poses without masks match the images: half of them are within
4 % of the person's height."""
NO_KNOWN_MISTAKE = (
    "No known mistake explains this. Poses or masks may belong to another video or person, "
    "tracking may have failed, or the masks hold more than this person (another one, a thing that "
    "touches them, very wide clothes). Recompute them from this video."
)
"""Diagnosis if no correction helps."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptureValidation:
    """Outcome of validating a capture.

    Attributes:
        geometry: Its poses and cameras as stored.
        images: Images in which the person was tracked.
        objective: Masks of some frames and key points of some images.
        refusal: Why ia-ingest would refuse the capture; None if it would not.
        anomalies: Sentences about implausible numbers.
        mask_iou: Mean IoU of body and masks as ia-ingest would read them; None without masks.
    """

    capture: Capture
    geometry: CaptureGeometry
    images: tuple[TrackedImage, ...]
    objective: CaptureObjective
    diagnosis: CorrectionResult
    refusal: str | None
    anomalies: tuple[str, ...]
    mask_iou: float | None

    @property
    def causes(self) -> tuple[str, ...]:
        """Names of the mistakes found, most important first."""
        return tuple(dict.fromkeys(cure.cause for cure in self.diagnosis.corrections))

    @property
    def verdict(self) -> str:
        """Verdict: `good`, `warn` or `unusable`."""
        if self.refusal is not None or (self.mask_iou is not None and self.mask_iou < USABLE_IOU):
            return "unusable"
        if self.mask_iou is None:
            well = (self.keypoint_score(self.geometry) or 0.0) >= GOOD_KEYPOINT_SCORE
        else:
            well = self.mask_iou >= GOOD_IOU
        explained = not self.causes or self.is_auto_corrected
        return "good" if well and explained and not self.anomalies else "warn"

    @property
    def is_usable_after_fix(self) -> bool:
        """True if the corrected capture can be trained on."""
        if self.objective.masks is None:
            return (self.keypoint_score(self.diagnosis.corrected) or 0.0) >= GOOD_KEYPOINT_SCORE
        return self.corrected_iou >= USABLE_IOU

    @property
    def is_auto_corrected(self) -> bool:
        """True if ia-ingest corrects everything that is wrong automatically."""
        files = mask_files(self.capture)
        return self.causes == ("mask_polarity",) and files is not None and files.inverted

    @property
    def agreement(self) -> str:
        """Sentences on how masks, key points and body agree as stored."""
        score = self.keypoint_score(self.geometry)
        if self.objective.masks is None:
            return (
                "There are no masks, and no person was found in the images."
                if score is None
                else "There are no masks (ia-ingest estimates them from poses and images). Score "
                f"of the tracked key points: {score:.2f} (0.7 to 0.9 is usual)."
            )
        video = any(each.is_of_video for each in self.diagnosis.corrections)
        but = " The masks do not match the images." if video else ""
        return f"IoU of body and masks: {self.stored_iou:.2f}.{but}"

    @property
    def expected_improvement(self) -> str:
        """Sentence on the scores after correction; empty without causes."""
        if not self.causes:
            return ""
        scores, of_video = [], [each.is_of_video for each in self.diagnosis.corrections]
        if self.objective.masks is not None and not all(of_video):
            scores.append(f"IoU after correction: {self.corrected_iou:.2f}")
        now, after = map(self.keypoint_score, (self.geometry, self.diagnosis.corrected))
        if now is not None and (any(of_video) or not scores):
            scores.append(f"Score of the tracked key points: {after:.2f} instead of {now:.2f}")
        return f"{'. '.join(scores)}."

    @property
    def stored_iou(self) -> float:
        """IoU of body and masks as stored; NaN without masks."""
        return self._iou(self.geometry)

    @property
    def corrected_iou(self) -> float:
        """IoU of body and masks after all corrections; NaN without masks."""
        return self._iou(self.diagnosis.corrected)

    def _iou(self, geometry: CaptureGeometry) -> float:
        masks = self.objective.masks
        return float("nan") if masks is None else mean_score(masks.frame_scores(geometry))

    def keypoint_score(self, geometry: CaptureGeometry) -> float | None:
        """Agreement of tracked key points with the body, in [0, 1]; None if no person was found."""
        keypoints = self.objective.keypoints
        return None if keypoints is None else mean_score(keypoints.frame_scores(geometry))


def check_capture(imported: ImportedCapture) -> CaptureValidation:
    """Align a capture, with its video rotated if that explains an error, and validate it."""
    try:
        capture = align_capture(imported, skip_checks=True)
        return check_aligned_capture(capture)
    except InputError as error:
        with suppress(InputError):
            rotated = align_capture(imported.transposed(), skip_checks=True)
            found = check_aligned_capture(rotated, str(error))
            if any(each.is_of_video for each in found.diagnosis.corrections):
                return found
        raise


def check_aligned_capture(capture: Capture, refused: str | None = None) -> CaptureValidation:
    """Validate an aligned capture; `refused` says why ia-ingest would not have opened it."""
    geometry, source, files = _stored_geometry(capture), capture.source, mask_files(capture)
    refused = implausibility_reason(capture.motion) or refused
    try:
        capture.check()
    except InputError as error:
        refused = refused or str(error)
    sampled = _sample_masks(capture) if capture.masks.is_given else None
    images = track_images(source)
    objective = CaptureObjective(
        masks=sampled, keypoints=KeypointObjective.of(images, capture.shaped)
    )
    count = source.frame_count or len(capture.motion)
    chosen = source.selection
    frames = [chosen.start + chosen.step * number for number in range(count)]
    search = CorrectionSearch(
        objective=objective, pelvis=capture.shaped.joints[0], frames=count,
        mask_count=0 if files is None else files.count,
    )  # fmt: skip
    upright = replace(geometry, masks_inverted=False)
    return CaptureValidation(
        capture=capture, geometry=geometry, images=images, objective=objective,
        diagnosis=search.run(geometry), refusal=refused,
        mask_iou=None if sampled is None else mean_score(sampled.frame_scores(upright)),
        anomalies=(
            *sanity_warnings(geometry, frames), *mask_warnings(sampled, source.size_px[1])
        ),
    )  # fmt: skip


def passes_quick_check(capture: Capture) -> bool:
    """Check a few masks in a few hundredths of a second, also for poses a frame or two late."""
    if not capture.masks.is_given:
        return True  # nothing to compare with
    try:
        masks = _sample_masks(capture, 8)
    except InputError:  # these masks are empty; reading all of them reports that
        return True
    geometry = replace(_stored_geometry(capture), masks_inverted=False)
    now = mean_score(masks.frame_scores(geometry))
    shifts = [
        mean_score(masks.frame_scores(undo_pose_delay(offset).apply(geometry)))
        for offset in (1, -1, 2, -2)
    ]
    # inexact poses gain 0.01 by chance
    return now >= GOOD_IOU and now >= max(shifts) - 0.75 * MIN_GAIN


def mask_files(capture: Capture) -> Masks | None:
    """Return the masks of a file or a folder; None if they come from elsewhere."""
    return capture.masks.files if isinstance(capture.masks, StoredMasks) else None


def _sample_masks(capture: Capture, count: int = SAMPLED_FRAMES) -> SilhouetteObjective:
    masks = capture.masks
    masks = masks.in_order_at_worst() if isinstance(masks, StoredMasks) else masks
    skin = SkinPoints.of(capture.shaped)
    return sample_masks(capture.source, masks, capture.cameras, skin, count=count)


def _stored_geometry(capture: Capture) -> CaptureGeometry:
    files = mask_files(capture)
    return replace(capture.geometry(), masks_inverted=files is not None and files.inverted)


def check_command(inputs: CaptureInputs, *, fix: bool = True) -> str:
    """Return an ia-check command for a shell; with `fix`, it writes a corrected copy."""
    named = ("poses", "masks", "cameras", "body", "person")
    options = option_words({name: getattr(inputs, name) for name in named})
    words = ["ia-check", str(inputs.video), *options]
    if inputs.invert_masks is not None:
        words.append("--mask-invert" if inputs.invert_masks else "--no-mask-invert")
    if inputs.frames is not None and inputs.frames != slice(None):
        words.append(f"--frames={format_frame_range(inputs.frames)}")
    if fix:
        beside = inputs.video if inputs.video.name else inputs.video.absolute()
        free = unused_path(beside.with_name(f"{capture_name(beside)}-corrected"))
        words += ["--fix", str(free)]
    return quote_command(*words)


def preflight_check(
    capture: Capture, inputs: CaptureInputs, console: Console, *, force: bool
) -> None:
    """Check a few masks; diagnose the capture only if they and the poses disagree.

    Live sources are not checked. `inputs` are for the suggested command. An unusable
    capture is refused; with `force` the user is only warned.
    """
    if passes_quick_check(capture):
        return
    with console.status("poses and masks disagree; diagnosing"):
        found = check_aligned_capture(capture)
    causes, iou = set(found.causes) - {"mask_polarity"}, found.mask_iou or 0.0
    unusable = found.verdict == "unusable"
    if not (unusable or causes or iou < GOOD_IOU):
        return
    expected = f" ({GOOD_IOU} or more expected)" if unusable else ""
    message = f"{found.agreement}{expected} {_explain(found)} {_suggest_command(found, inputs)}"
    if unusable and not force:
        raise InputError(f"{message} To train anyway, pass --force.")
    console.warning(message)


def correction_hint(imported: ImportedCapture) -> str:
    """Suggest a correction for a capture that could not be aligned; empty if none is known."""
    with suppress(InputError):
        found = check_capture(imported)
        return (
            f"{_explain(found)} {_suggest_command(found, imported.inputs)}" if found.causes else ""
        )
    return ""


def _explain(check: CaptureValidation) -> str:
    if not check.causes:
        return NO_KNOWN_MISTAKE
    words = "; and ".join(each.description for each in check.diagnosis.corrections)
    return f"Probable cause: {words}. {check.expected_improvement}".strip()


def _suggest_command(check: CaptureValidation, inputs: CaptureInputs) -> str:
    aim = "correct" if check.causes else "inspect"
    return f"To {aim} it: {check_command(inputs, fix=bool(check.causes))}"

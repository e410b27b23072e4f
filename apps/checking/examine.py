"""A capture examined: what is odd in its numbers, how body and masks agree, what would mend it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32

from apps.recording.opening import open_recording
from apps.recording.recording import Recording
from apps.recording.wanted import RecordingPaths
from capture.camera import same_shape
from capture.errors import BadInput
from preprocess.doctor.claim import Claim
from preprocess.doctor.cure import shifted
from preprocess.doctor.diagnosis import GOOD, USABLE, Diagnosis, diagnose, film_errs, mean
from preprocess.doctor.evidence import FRAMES, Evidence, gather
from preprocess.doctor.film_evidence import PICTURES, WITHIN, FilmEvidence, gather_film
from preprocess.doctor.soundness import unsound
from preprocess.fit.pictures import edges, glance
from preprocess.masks.files import Masks
from preprocess.observe import check_cameras, check_masks
from preprocess.plausibility import impossible
from preprocess.silhouette import SkinPoints

FEW = 8
"""Frames that are looked at before a run begins."""
FIRST = 96
"""Frames of the film's beginning among which its pictures are then looked at."""
GOOD_EDGES = 2.0
"""Least ratio of the edges across the body's outline to those beside it, if poses fit."""
UNEXPLAINED = (
    "None of the usual mistakes explains it. Are the poses or the masks of another video or "
    "person, or did the tracker lose the person? Make them again from this video."
)
NEAR = (1, 2)
"""Offsets of the poses, in frames, that are tried even where all seems well."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Examined:
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

    recording: Recording
    claim: Claim
    evidence: Evidence | None
    diagnosis: Diagnosis | None
    refused: str | None
    odd: tuple[str, ...]
    agreed: float | None
    edges: float | None = None

    @property
    def causes(self) -> tuple[str, ...]:
        """Names of the mistakes found, the one that matters most first."""
        cures = self.diagnosis.cures if self.diagnosis else ()
        return tuple(dict.fromkeys(cure.cause for cure in cures))

    @property
    def verdict(self) -> str:
        """`good`, `warn`, or `unusable`."""
        if self.refused is not None or (self.agreed is not None and self.agreed < USABLE):
            return "unusable"
        well = self.agreed is not None and self.agreed >= GOOD
        well = well and (not self.causes or self.mends_itself)
        well |= self.edges is not None and self.edges >= GOOD_EDGES
        return "good" if well and not self.odd else "warn"

    @property
    def mends_itself(self) -> bool:
        """Whether all that is wrong is what ia-ingest corrects without being asked."""
        masks = self.recording.masks
        return self.causes == ("mask_polarity",) and masks is not None and masks.inverted

    @property
    def film_errs(self) -> bool:
        """Whether a mistake was found that concerns the pictures alone."""
        return any(cause.startswith("film_") for cause in self.causes)

    @property
    def promise(self) -> str:
        """What correcting the named mistakes would bring, for people; empty without masks."""
        if self.diagnosis is None or not self.causes:
            return ""
        told = []
        if not all(cause.startswith("film_") for cause in self.causes):
            told.append(f"body and masks would agree by {self.after:.2f}")
        if self.film_errs and self.diagnosis.film is not None:
            film = self.diagnosis.film
            before = f" instead of {film.now:.2f}" if film.now > 0.0 else ""
            told.append(
                f"the masks' outlines would score {film.after:.2f}{before} on the pictures' edges "
                "(0.5 is chance)"
            )
        return f"Once corrected, {', and '.join(told)}."

    @property
    def now(self) -> float:
        """Agreement of the files as they are stored; NaN without masks."""
        return self.diagnosis.now if self.diagnosis else float("nan")

    @property
    def after(self) -> float:
        """Agreement with all cures; NaN without masks."""
        return self.diagnosis.after if self.diagnosis else float("nan")


def examine(wanted: RecordingPaths) -> Examined:
    """Opens a capture and looks at it; nothing is trained and hardly a frame is decoded.

    Raises:
        BadInput: If a part is missing or unreadable, so that there is nothing to examine.
    """
    try:
        return examined(*_opened(wanted))
    except BadInput as error:
        found = _transposed(wanted, str(error))
        if found is None:
            raise
        return found


def _transposed(wanted: RecordingPaths, refused: str) -> Examined | None:
    """What is found if the film was rotated by a quarter turn; None if that explains nothing."""
    try:
        recording = open_recording(replace(wanted, transposed=True), doubtful=True)
        found = examined(recording, refused)
    except BadInput:
        return None
    return found if found.film_errs else None


def examined(recording: Recording, undecided: str | None = None) -> Examined:
    """The same for a capture that is open already.

    Args:
        recording: The capture.
        undecided: Why nobody knows which side of the masks is the person, if so.

    Raises:
        BadInput: If a part is unreadable, so that there is nothing to examine.
    """
    claim, refused = _claim(recording), impossible(recording.motion) or undecided
    try:
        recording.check()
    except BadInput as error:
        refused = refused or str(error)
    masked = recording.masks is not None or recording.source.has_alpha
    evidence = _evidence(recording) if masked else None
    count = recording.source.frame_count or len(recording.motion)
    selection = recording.source.selection
    frames = [selection.start + selection.step * number for number in range(count)]
    diagnosis = agreed = None
    if evidence is not None:
        diagnosis = diagnose(claim, evidence, count, _film(recording, evidence))
        agreed = mean(evidence.scores(replace(claim, inverted=False)))
    odd = unsound(claim, frames, evidence, recording.source.size_px[1])
    return Examined(
        recording=recording, claim=claim, evidence=evidence, diagnosis=diagnosis,
        refused=refused, odd=tuple(odd), agreed=agreed,
        edges=None if masked or refused else _edges(recording, claim),
    )  # fmt: skip


def looks_well(recording: Recording) -> bool:
    """A glance at a few masks, in a few hundredths of a second: whether there is nothing to say.

    Poses that are a frame or two late are noticed, too.
    """
    if recording.live is not None or not (recording.masks or recording.source.has_alpha):
        return True  # what is not there cannot be looked at
    try:
        evidence = _evidence(recording, FEW)
    except BadInput:  # nobody in these few; whoever reads all of them will say so
        return True
    claim = replace(_claim(recording), inverted=False)
    now = mean(evidence.scores(claim))
    shifts = [mean(evidence.scores(shifted(k).undo(claim))) for n in NEAR for k in (n, -n)]
    if now < GOOD or now < max(shifts):
        return False
    film = None if evidence.boxes else _film(recording, evidence, FEW, FIRST)
    return film is None or not film_errs(claim, film, recording.source.frame_count or 1)


def _edges(recording: Recording, claim: Claim) -> float | None:
    """How the body's outline runs along the pictures' edges; None if none can be looked at."""
    skin = SkinPoints.of(recording.shaped)
    try:
        return edges(claim, skin, glance(claim, skin, recording.cameras, recording.source))
    except BadInput:
        return None


def _film(
    recording: Recording, evidence: Evidence, count: int = PICTURES, within: int = WITHIN
) -> FilmEvidence | None:
    """Some pictures and all masks; None where the masks lie in the pictures themselves."""
    masks = recording.masks
    if masks is None:
        return None
    return gather_film(
        recording.source, masks_of(recording, masks, evidence.size_px), masks.count,
        evidence.size_px, count=count, within=within,
    )  # fmt: skip


def masks_of(
    recording: Recording, masks: Masks, size_px: tuple[int, int]
) -> Callable[[int], Float32[np.ndarray, "height width"]]:
    """From a frame's number, which may be beyond the film's, to its mask of a given size.

    What is returned raises BadInput where there is no such mask.
    """
    row_of = _mask_rows(recording)

    def alpha(number: int) -> Float32[np.ndarray, "height width"]:
        row = row_of(number)
        if not 0 <= row < masks.count:
            raise BadInput(f"There is no mask for frame {number} in {masks.path}.")
        return masks.alpha(row, size_px)

    return alpha


def _mask_rows(recording: Recording) -> Callable[[int], int]:
    """From a frame's number to its mask; in order where there is not one mask for each frame.

    Raises:
        BadInput: If they are of another shape.
    """
    try:
        return check_masks(recording.masks, recording.source)
    except BadInput:
        masks = recording.masks
        if masks is None or not same_shape(masks.size_px, recording.source.size_px):
            raise
        path, count = masks.path, masks.count

    def in_order(index: int) -> int:
        if index >= count:
            raise BadInput(f"There is no mask for frame {index} in {path}.")
        return index

    return in_order


def _evidence(recording: Recording, count: int = FRAMES) -> Evidence:
    mask_row = _mask_rows(recording)
    camera_row = check_cameras(recording.cameras, recording.source)
    return gather(
        recording.source, recording.masks, mask_row, camera_row, SkinPoints.of(recording.shaped),
        count=count, without=recording.cameras.missing,
    )  # fmt: skip


def _claim(recording: Recording) -> Claim:
    """As the files say; masks that are turned while they are read were claimed the other way."""
    claim = Claim.of(recording.motion, recording.cameras, recording.source)
    turned = recording.masks is not None and recording.masks.inverted
    return replace(claim, inverted=turned)


def _opened(wanted: RecordingPaths) -> tuple[Recording, str | None]:
    """The capture, and why a run would refuse its masks if it cannot tell which side is whom."""
    try:
        return open_recording(wanted, doubtful=True), None
    except BadInput as error:
        if wanted.mask_invert is not None:
            raise
        recording = open_recording(replace(wanted, mask_invert=False), doubtful=True)
        return recording, str(error)


def share(value: float | None) -> float | None:
    """A number for JSON, which knows no NaN."""
    return None if value is None or not np.isfinite(value) else round(float(value), 4)

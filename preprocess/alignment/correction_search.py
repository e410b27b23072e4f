"""Finds the mistakes that, undone, make body, masks and pictures agree."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from preprocess.alignment.camera_from_masks import (
    fit_extrinsics,
    fit_factor,
    fit_principal_point,
)
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.correction_catalog import body_corrections, video_corrections
from preprocess.alignment.corrections import (  # fmt: skip
    CAUSES,
    Correction,
    divide_distances,
    scale_focal_length,
    undo_pose_delay,
    undo_video_crop,
    undo_video_offset,
)
from preprocess.alignment.edge_objective import EdgeObjective
from preprocess.alignment.sanity_checks import find_jumps
from preprocess.alignment.silhouette_objective import (
    SilhouetteObjective,
    mean_score,
    mean_with_missing,
)

GOOD_IOU, USABLE_IOU = 0.7, 0.5
"""Agreement from which a capture is well, and below which nothing can be learnt from it."""
CAMERA_SEARCH_BELOW_IOU, CAMERA_SEARCH_MIN_GAIN = 0.65, 0.05
"""Below the first, what was found explains little, and the camera is sought in the masks; it must
explain so much more, as it has six numbers to be fitted."""
MIN_IOU_GAIN = 0.02
"""What a discrete cure must win to be named."""
MIN_FITTED_IOU_GAIN, MIN_FITTED_CHANGE = 0.04, 0.06
"""What a fitted one must win and change (relatively): clothes make everybody a little larger."""
FITTED_CAUSES = ("focal", "body_scale")
MIN_EDGE_GAIN, MIN_CROP_EDGE_GAIN, MIN_EDGE_SCORE = 0.03, 0.04, 0.6
"""What a change of the film must win of the edges' score, and what it must reach to be named."""
MIN_CROP_FRACTION = 0.02
"""Fraction of the picture by which a side must be cut off, or added, to be named."""
CLEAR_EDGE_SCORE = 0.66
"""Score of the edges from which only offsets of a few frames are tried."""
MIN_STANDARD_ERRORS = 3.0
"""By how many standard errors, over the frames, a gain must be above nothing."""
MAX_LOST_FRACTION = 0.3
"""Share of the frames with poses by which a cure may leave fewer before they count as missed."""
MAX_CORRECTIONS = 3
COARSE_SAMPLES = 6
"""Frames of the first look; guesses among the best `KEPT` there are looked at in all frames."""
MAX_CANDIDATES = 8
"""Guesses that are looked at in all frames."""
NEAR_OFFSET_FRAMES = 2
"""Offsets of a film, in frames, that are tried even where it seems well."""
TIE_SCORE = 0.004
"""Gains this close are equal; then the cause that stands first in `CAUSES` is named."""


@runtime_checkable
class Objective(Protocol):
    """What says how well a claim fits each of a few frames, in [0, 1]."""

    def frame_scores(self, geometry: CaptureGeometry) -> Float[np.ndarray, "witnesses"]:
        """The score of each frame; NaN where nothing can be compared."""
        ...

    def subset(self, count: int) -> "Objective":
        """At most `count` of the frames."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class CorrectionCandidate:
    """A guess, and the agreement it would bring: in the mean, and in each frame.

    The agreement is that of body and masks (intersection over union), or of masks and pictures
    (the edges' score of `EdgeObjective`).
    """

    correction: Correction
    mean_score: float
    frame_scores: Float[np.ndarray, "witnesses"]


@dataclass(frozen=True, eq=False, kw_only=True)
class CorrectionSearch:
    """What is tried, against what, and when it is worth naming.

    Attributes:
        evidence: What every guess is held against.
        listed: Every discrete mistake that a claim may have.
        fitted: Those with a size, as it fits a claim and a few frames best.
        shift: Makes the cure of an offset; its neighbors are tried around the best one.
        gain, min_fitted_gain: What a discrete and a fitted cure must win to be named.
        min_fitted_change: By how much a fitted cure must change its number, relatively.
        fits: What the result must reach, too.
        polish: What fits a fitted cure again after others were applied; None leaves it.
    """

    objective: Objective
    discrete: Callable[[CaptureGeometry], Iterable[Correction]]
    fit_continuous: Callable[[CaptureGeometry, Any], list[Correction]]
    make_shift: Callable[[int], Correction]
    min_gain: float = MIN_IOU_GAIN
    min_fitted_gain: float = MIN_FITTED_IOU_GAIN
    min_fitted_change: float = MIN_FITTED_CHANGE
    min_score: float = 0.0
    refit: Callable[[Correction, CaptureGeometry], Correction] | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class CorrectionResult:
    """What is wrong with a capture.

    Attributes:
        now: Mean agreement as the files are, in [0, 1].
        after: The same with all named cures.
        cures: The mistakes found, the one that matters most first, as they are to be undone.
        tried: The best guess of each cause in the first round, best first.
        scores: Each frame's agreement as the files are; NaN where a frame has no pose.
        healed: The claim with all cures.
        film: How the pictures' edges follow the masks; None if no picture was looked at.
    """

    iou_before: float
    iou_after: float
    corrections: tuple[Correction, ...]
    candidates: tuple[CorrectionCandidate, ...]
    frame_iou: Float[np.ndarray, "witnesses"]
    corrected: CaptureGeometry
    video: "VideoEdgeResult | None" = None


@dataclass(frozen=True, eq=False, kw_only=True)
class VideoEdgeResult:
    """How the pictures' edges follow the masks' outlines: about 0.5 by chance, 0.65 and more well.

    Attributes:
        now: Mean score as the files are.
        after: Mean score with all named cures.
        tried: The best guess of each cause that concerns the film alone, best first.
    """

    score_before: float
    score_after: float
    candidates: tuple[CorrectionCandidate, ...]


def find_corrections(
    geometry: CaptureGeometry,
    objective: SilhouetteObjective,
    frames: int,
    edge_objective: EdgeObjective | None = None,
) -> CorrectionResult:
    """Tries the usual mistakes, and again with the best one undone, while that helps.

    Then the same with mistakes of the film alone, which body and masks cannot tell.

    Args:
        claim: What the files say.
        evidence: Masks of a few frames.
        frames: How many frames the capture has.
        film: A few of its pictures; None if pictures and masks cannot disagree.
    """
    found = _find_body_corrections(geometry, objective, frames)
    if edge_objective is None or objective.are_boxes or not edge_objective.images:
        return found
    search = video_search(found.corrected, edge_objective, frames)
    named, healed, tried = _greedy_search(found.corrected, search)
    fit = VideoEdgeResult(
        score_before=mean_score(edge_objective.frame_scores(geometry)),
        score_after=mean_score(edge_objective.frame_scores(healed)),
        candidates=tried,
    )
    return replace(found, corrections=(*found.corrections, *named), corrected=healed, video=fit)


def _find_body_corrections(
    claim: CaptureGeometry, evidence: SilhouetteObjective, frames: int
) -> CorrectionResult:
    """What is wrong between body and masks."""
    first = evidence.frame_scores(claim)
    search = _body_search(evidence, frames)
    named, healed, tried = _greedy_search(claim, search)
    for sought in (
        (fit_principal_point,) if find_jumps(claim)[0] else (fit_principal_point, fit_extrinsics)
    ):
        so_far = mean_score(evidence.frame_scores(healed))
        if (
            so_far >= CAMERA_SEARCH_BELOW_IOU and len(named) < MAX_CORRECTIONS
        ) or evidence.are_boxes:
            break
        found = sought(claim, evidence)
        if found is None:
            continue
        others, better, _ = _greedy_search(found.apply(claim), search)
        least, scores = (
            GOOD_IOU if sought is fit_principal_point else USABLE_IOU,
            evidence.frame_scores(better),
        )
        gained = mean_score(scores) > max(least, so_far + CAMERA_SEARCH_MIN_GAIN)
        if gained and np.nanpercentile(scores, 10) > USABLE_IOU:  # or it is a bargain between two
            named, healed = [found, *others], better
            tried = _best_per_cause([*tried, *_evaluate([found], claim, evidence)])
    return CorrectionResult(
        iou_before=mean_score(first), iou_after=mean_score(evidence.frame_scores(healed)), corrections=tuple(named), candidates=tried,
        frame_iou=first, corrected=healed,
    )  # fmt: skip


def _body_search(evidence: SilhouetteObjective, frames: int) -> CorrectionSearch:
    """The search for mistakes between body and masks."""
    pelvis = evidence.skin.shaped.joints[0]

    def polished(cure: Correction, claim: CaptureGeometry) -> Correction:
        make = _correction_factory(cure.cause, pelvis)
        again = fit_factor(make, claim, evidence, near_one=True).factor or 1.0
        return make((cure.factor or 1.0) * again)

    return CorrectionSearch(
        objective=evidence,
        discrete=lambda claim: body_corrections(claim, pelvis, frames),
        fit_continuous=_fit_continuous,
        make_shift=undo_pose_delay,
        refit=polished,
    )


def video_search(
    geometry: CaptureGeometry, objective: EdgeObjective, frames: int, *, quick: bool = False
) -> CorrectionSearch:
    """The search for mistakes of the film alone.

    Args:
        claim: Poses, masks and film as they are.
        film: A few pictures and all masks.
        frames: How many frames the film has.
        quick: Leaves out what takes long: distant offsets and crops.
    """
    clear = quick or mean_score(objective.frame_scores(geometry)) >= CLEAR_EDGE_SCORE
    reach = NEAR_OFFSET_FRAMES if clear else max(frames, objective.mask_count)

    def windows(tried: CaptureGeometry, few: EdgeObjective) -> list[Correction]:
        return [] if quick else [undo_video_crop(few.fit_window(tried))]

    return CorrectionSearch(
        objective=objective,
        discrete=lambda tried: video_corrections(frames, objective.mask_count, reach),
        fit_continuous=windows,
        make_shift=undo_video_offset,
        min_gain=MIN_EDGE_GAIN,
        min_fitted_gain=MIN_CROP_EDGE_GAIN,
        min_fitted_change=MIN_CROP_FRACTION,
        min_score=MIN_EDGE_SCORE,
    )


def needs_video_correction(
    geometry: CaptureGeometry, objective: EdgeObjective, frames: int
) -> bool:
    """Whether one of the likeliest mistakes of the film alone is worth naming; a quick look."""
    search = video_search(geometry, objective, frames, quick=True)
    scores = objective.frame_scores(geometry)
    guesses = _evaluate(search.discrete(geometry), geometry, objective)
    return any(_is_significant(guess, geometry, scores, search) for guess in guesses)


def _greedy_search(
    claim: CaptureGeometry, search: CorrectionSearch
) -> tuple[list[Correction], CaptureGeometry, tuple[CorrectionCandidate, ...]]:
    """Undoes what helps most, again and again: the cures, the result, the first round's guesses."""
    evidence = search.objective
    scores = evidence.frame_scores(claim)
    named: list[Correction] = []
    tried: tuple[CorrectionCandidate, ...] = ()
    healed = claim
    while len(named) < MAX_CORRECTIONS:
        guesses = _best_candidates(healed, search)
        worth = [guess for guess in guesses if _is_significant(guess, healed, scores, search)]
        if not named:
            tried = _best_per_cause(guesses)
        if not worth:
            break
        best = max(guess.mean_score for guess in worth)
        level = [guess for guess in worth if guess.mean_score > best - TIE_SCORE]
        chosen = min(level, key=lambda guess: CAUSES.index(guess.correction.cause)).correction
        named.append(chosen)
        healed = chosen.apply(healed)
        scores = evidence.frame_scores(healed)
    return *_refit_continuous(named, claim, healed, search), tried


def _refit_continuous(
    named: list[Correction],
    claim: CaptureGeometry,
    corrected: CaptureGeometry,
    search: CorrectionSearch,
) -> tuple[list[Correction], CaptureGeometry]:
    """Fits again what was fitted before other mistakes were undone."""
    for place, cure in enumerate(named[:-1]):
        if cure.factor is not None and search.refit is not None:
            named[place] = search.refit(cure, corrected)
            corrected = claim
            for each in named:
                corrected = each.apply(corrected)
    return named, corrected


def _correction_factory(
    cause: str, pelvis: Float[np.ndarray, "3"]
) -> Callable[[float], Correction]:
    """What makes a cure of a factor."""
    return (
        scale_focal_length if cause == "focal" else lambda factor: divide_distances(factor, pelvis)
    )


def _best_candidates(claim: CaptureGeometry, search: CorrectionSearch) -> list[CorrectionCandidate]:
    """The most promising guesses, looked at in all frames."""
    few = search.objective.subset(COARSE_SAMPLES)
    guesses = _evaluate(search.discrete(claim), claim, few)
    shifts = [guess for guess in guesses if guess.correction.frame_shift is not None]
    guesses += _evaluate(_refine_shifts(shifts, search.make_shift), claim, few)
    guesses += _evaluate(search.fit_continuous(claim, few), claim, few)
    guesses.sort(key=lambda guess: -guess.mean_score)
    kept = guesses[:MAX_CANDIDATES] + list(_best_per_cause(guesses[MAX_CANDIDATES:]))
    return _evaluate([guess.correction for guess in kept], claim, search.objective)


def _evaluate(
    corrections: Iterable[Correction], claim: CaptureGeometry, evidence: Objective
) -> list[CorrectionCandidate]:
    looked = [(cure, evidence.frame_scores(cure.apply(claim))) for cure in corrections]
    return [
        CorrectionCandidate(
            correction=cure, mean_score=mean_with_missing(scores), frame_scores=scores
        )
        for cure, scores in looked
    ]


def _refine_shifts(
    shifts: list[CorrectionCandidate], make: Callable[[int], Correction]
) -> list[Correction]:
    """Offsets around the best of the coarse ones."""
    if not shifts:
        return []
    center = max(shifts, key=lambda guess: guess.mean_score).correction.frame_shift or 0
    reach = max(1, abs(center) // 5)
    around = range(center - reach, center + reach + 1)
    return [make(k) for k in around if k not in (0, center)]


def _fit_continuous(claim: CaptureGeometry, evidence: SilhouetteObjective) -> list[Correction]:
    """The focal length and the size that fit best, one at a time."""
    if evidence.are_boxes:
        return []
    pelvis = evidence.skin.shaped.joints[0]
    return [
        fit_factor(_correction_factory(cause, pelvis), claim, evidence) for cause in FITTED_CAUSES
    ]


def _best_per_cause(guesses: list[CorrectionCandidate]) -> tuple[CorrectionCandidate, ...]:
    best: dict[str, CorrectionCandidate] = {}
    for guess in guesses:
        if (
            guess.correction.cause not in best
            or guess.mean_score > best[guess.correction.cause].mean_score
        ):
            best[guess.correction.cause] = guess
    return tuple(sorted(best.values(), key=lambda guess: -guess.mean_score))


def _is_significant(
    guess: CorrectionCandidate,
    claim: CaptureGeometry,
    scores: Float[np.ndarray, "witnesses"],
    search: CorrectionSearch,
) -> bool:
    """Whether a guess wins enough, in frame after frame."""
    gains = guess.frame_scores - np.nan_to_num(scores)
    had, has = np.isfinite(scores), np.isfinite(guess.frame_scores)
    if (
        had.sum() - has.sum() > MAX_LOST_FRACTION * had.sum()
    ):  # it explains the rest, and gives these away
        gains = np.where(had & ~has, -np.nan_to_num(scores), gains)
    gains = gains[np.isfinite(gains)]
    if 2 * len(gains) < len(scores) or mean_score(guess.frame_scores) < search.min_score:
        return False
    fitted = guess.correction.factor is not None
    if fitted and _relative_change(claim, guess.correction.apply(claim)) < search.min_fitted_change:
        return False
    error = gains.std(ddof=1) / np.sqrt(len(gains)) if len(gains) > 1 else 0.0
    least = search.min_fitted_gain if fitted else search.min_gain
    return bool(gains.mean() > least and gains.mean() > MIN_STANDARD_ERRORS * error)


def _relative_change(before: CaptureGeometry, after: CaptureGeometry) -> float:
    """How far a fitted cure moves its number, relatively."""
    focal = after.intrinsics[0, 0, 0] / before.intrinsics[0, 0, 0]
    there, valid = before.motion.root_translations, before.motion.valid
    moved = np.linalg.norm((after.motion.root_translations - there)[valid])
    size = moved / max(float(np.linalg.norm(there[valid])), 1e-9)
    film = np.abs(np.subtract(after.video_transform.window, before.video_transform.window)).max()
    return max(abs(float(np.log(focal))), float(size), float(film))

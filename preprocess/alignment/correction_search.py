"""Find the mistakes that, undone, make body, masks and images agree.

A greedy search applies the best correction again and again while its gain in score is significant.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from preprocess.alignment.capture_geometry import CaptureGeometry, find_jumps, relative_change
from preprocess.alignment.correction_catalog import body_corrections, video_corrections
from preprocess.alignment.corrections import (  # fmt: skip
    CAUSES,
    Correction,
    divide_distances,
    fit_extrinsics,
    fit_factor,
    fit_principal_point,
    scale_focal_length,
    stretch_width,
    undo_pose_delay,
    undo_video_crop,
    undo_video_offset,
)
from preprocess.alignment.edge_objective import EdgeObjective
from preprocess.alignment.silhouette_objective import (
    GOOD_IOU,
    USABLE_IOU,
    SilhouetteObjective,
    mean_score,
    mean_with_missing,
)

MIN_STANDARD_ERRORS = 3.0
"""Standard errors, over the frames, by which a gain must exceed 0."""
MAX_LOST_FRACTION = 0.3
"""Fraction of the frames with poses that a correction may leave without; more count as IoU 0."""
MAX_CORRECTIONS = 3
"""Corrections that are named at most."""
COARSE_SAMPLES = 6
"""Frames in which every candidate is scored."""
MAX_CANDIDATES = 8
"""Best candidates of the coarse scores that are scored in all frames."""
TIE_SCORE = 0.004
"""Scores this close are equal; then the cause that stands first in `CAUSES` is named."""
CAMERA_SEARCH_BELOW_IOU = 0.65
"""Mean IoU below which the listed corrections explain too little: a camera is fitted as well."""
CAMERA_SEARCH_MIN_GAIN = 0.05
"""Gain in mean IoU that a fitted camera must bring; larger, as it has up to six parameters."""
MIN_IOU_GAIN = 0.02
"""Gain in mean IoU that a discrete correction must bring."""
MIN_FITTED_IOU_GAIN = 0.04
"""Gain in mean IoU that a fitted correction must bring: clothes make every body a little larger."""
MIN_FITTED_CHANGE = 0.06
"""Relative change of its number that a fitted correction must make."""
MIN_EDGE_GAIN = 0.03
"""Gain in the mean edge score that a discrete correction of the video must bring."""
MIN_CROP_EDGE_GAIN = 0.04
"""Gain in the mean edge score that a crop must bring."""
MIN_EDGE_SCORE = 0.6
"""Mean edge score that a correction of the video must reach."""
MIN_CROP_FRACTION = 0.02
"""Fraction of the image that must be cut off or added on a side."""
CLEAR_EDGE_SCORE = 0.66
"""Mean edge score from which only offsets of a few frames are tried."""
NEAR_OFFSET_FRAMES = 2
"""Offsets of a video, frames, that are tried even where its edge score is clear."""

Objective = SilhouetteObjective | EdgeObjective
"""Scores how well a geometry fits each of a few frames, in [0, 1]; NaN where it cannot."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CorrectionCandidate:
    """A correction and the score it would bring: the mean, and that of each frame.

    The score is the IoU of body and masks, or the edge score of masks and images.
    """

    correction: Correction
    mean_score: float
    frame_scores: Float[np.ndarray, "samples"]


@dataclass(frozen=True, eq=False, kw_only=True)
class CorrectionSearch:
    """What is tried, how it is scored, and which gains are significant.

    Attributes:
        objective: Scores every candidate.
        discrete: Lists every discrete correction of a geometry.
        fit_continuous: Fits the corrections that have a size, to a geometry and a few frames.
        make_shift: Makes an offset's correction, for the neighbors of the best one.
        min_gain: Gain in score that a discrete correction must bring.
        min_fitted_gain: Gain in score that a fitted correction must bring.
        min_fitted_change: Relative change of its number that a fitted correction must make.
        min_score: Mean score that the result must reach.
        refit: Fits a fitted correction again after others were applied; None leaves it.
    """

    objective: Objective
    discrete: Callable[[CaptureGeometry], Iterable[Correction]]
    fit_continuous: Callable[[CaptureGeometry, Any], list[Correction]]
    make_shift: Callable[[int], Correction]
    min_gain: float
    min_fitted_gain: float
    min_fitted_change: float
    min_score: float = 0.0
    refit: Callable[[Correction, CaptureGeometry], Correction] | None = None


def greedy_search(
    geometry: CaptureGeometry, search: CorrectionSearch
) -> tuple[list[Correction], CaptureGeometry, tuple[CorrectionCandidate, ...]]:
    """The corrections, the corrected geometry, and the first round's best candidates."""
    scores = search.objective.frame_scores(geometry)
    chosen: list[Correction] = []
    first: tuple[CorrectionCandidate, ...] = ()
    corrected = geometry
    while len(chosen) < MAX_CORRECTIONS:
        candidates = _best_candidates(corrected, search)
        if not chosen:
            first = best_per_cause(candidates)
        candidates = [c for c in candidates if is_significant(c, corrected, scores, search)]
        if not candidates:
            break
        best = max(candidate.mean_score for candidate in candidates)
        tied = [each for each in candidates if each.mean_score > best - TIE_SCORE]
        correction = min(tied, key=lambda each: CAUSES.index(each.correction.cause)).correction
        chosen.append(correction)
        corrected = correction.apply(corrected)
        scores = search.objective.frame_scores(corrected)
    return *_refit_continuous(chosen, geometry, corrected, search), first


def _refit_continuous(
    chosen: list[Correction],
    geometry: CaptureGeometry,
    corrected: CaptureGeometry,
    search: CorrectionSearch,
) -> tuple[list[Correction], CaptureGeometry]:
    """Fits again what was fitted before other corrections were applied."""
    for number, correction in enumerate(chosen[:-1]):
        if correction.factor is not None and search.refit is not None:
            chosen[number] = search.refit(correction, corrected)
            corrected = geometry
            for each in chosen:
                corrected = each.apply(corrected)
    return chosen, corrected


def _best_candidates(
    geometry: CaptureGeometry, search: CorrectionSearch
) -> list[CorrectionCandidate]:
    """The best candidates of a few frames, and the best of each cause, scored in all frames."""
    few = search.objective.subset(COARSE_SAMPLES)
    candidates = evaluate(search.discrete(geometry), geometry, few)
    shifts = [each for each in candidates if each.correction.frame_shift is not None]
    candidates += evaluate(_refine_shifts(shifts, search.make_shift), geometry, few)
    candidates += evaluate(search.fit_continuous(geometry, few), geometry, few)
    candidates.sort(key=lambda each: -each.mean_score)
    kept = candidates[:MAX_CANDIDATES] + list(best_per_cause(candidates[MAX_CANDIDATES:]))
    return evaluate([each.correction for each in kept], geometry, search.objective)


def evaluate(
    corrections: Iterable[Correction], geometry: CaptureGeometry, objective: Objective
) -> list[CorrectionCandidate]:
    """Scores each correction, applied to the geometry alone."""
    scored = [(each, objective.frame_scores(each.apply(geometry))) for each in corrections]
    return [
        CorrectionCandidate(correction=each, mean_score=mean_with_missing(s), frame_scores=s)
        for each, s in scored
    ]


def _refine_shifts(
    shifts: list[CorrectionCandidate], make: Callable[[int], Correction]
) -> list[Correction]:
    """Offsets around the best of the coarse grid."""
    if not shifts:
        return []
    center = max(shifts, key=lambda each: each.mean_score).correction.frame_shift or 0
    reach = max(1, abs(center) // 5)
    return [make(k) for k in range(center - reach, center + reach + 1) if k not in (0, center)]


def best_per_cause(
    candidates: Iterable[CorrectionCandidate],
) -> tuple[CorrectionCandidate, ...]:
    """The best candidate of each cause, best first."""
    best: dict[str, CorrectionCandidate] = {}
    for each in sorted(candidates, key=lambda each: -each.mean_score):
        best.setdefault(each.correction.cause, each)
    return tuple(best.values())


def is_significant(
    candidate: CorrectionCandidate,
    geometry: CaptureGeometry,
    scores: Float[np.ndarray, "samples"],
    search: CorrectionSearch,
) -> bool:
    """Whether a candidate gains enough, frame by frame, over the current scores."""
    gains = candidate.frame_scores - np.nan_to_num(scores)
    had, has = np.isfinite(scores), np.isfinite(candidate.frame_scores)
    if had.sum() - has.sum() > MAX_LOST_FRACTION * had.sum():
        # It would explain some frames by giving up others: those count as lost.
        gains = np.where(had & ~has, -np.nan_to_num(scores), gains)
    gains = gains[np.isfinite(gains)]
    if 2 * len(gains) < len(scores) or mean_score(candidate.frame_scores) < search.min_score:
        return False
    correction = candidate.correction
    is_fitted = correction.factor is not None
    if is_fitted and relative_change(geometry, correction.apply(geometry)) < (
        search.min_fitted_change
    ):
        return False
    error = gains.std(ddof=1) / np.sqrt(len(gains)) if len(gains) > 1 else 0.0
    needed = search.min_fitted_gain if is_fitted else search.min_gain
    return bool(gains.mean() > max(needed, MIN_STANDARD_ERRORS * error))


@dataclass(frozen=True, eq=False, kw_only=True)
class VideoEdgeResult:
    """How the images' edges follow the masks' outlines: about 0.5 by chance, above 0.65 if well.

    Attributes:
        score_before: Mean edge score of the files as they are.
        score_after: Mean edge score with all corrections.
        candidates: The best candidate of each cause that concerns the video alone, best first.
    """

    score_before: float
    score_after: float
    candidates: tuple[CorrectionCandidate, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class CorrectionResult:
    """The mistakes found in a capture.

    Attributes:
        iou_before: Mean IoU of body and masks as the files are.
        iou_after: Mean IoU with all corrections.
        corrections: The corrections, the one with the largest gain first.
        candidates: The best candidate of each cause in the first round, best first.
        corrected: The geometry with all corrections.
        video: Edge scores of the video; None if no image was compared.
    """

    iou_before: float
    iou_after: float
    corrections: tuple[Correction, ...]
    candidates: tuple[CorrectionCandidate, ...]
    corrected: CaptureGeometry
    video: VideoEdgeResult | None = None


def find_corrections(
    geometry: CaptureGeometry,
    objective: SilhouetteObjective,
    frames: int,
    edge_objective: EdgeObjective | None = None,
) -> CorrectionResult:
    """Applies the best correction again and again while that helps significantly.

    First between body and masks; then, of the video alone, between masks and images.

    Args:
        geometry: The capture as its files state it.
        objective: Masks of a few frames.
        frames: Number of frames in the capture.
        edge_objective: A few of its images; None if images and masks cannot disagree.
    """
    found = _find_body_corrections(geometry, objective, frames)
    if edge_objective is None or objective.are_boxes or not edge_objective.images:
        return found
    search = video_search(found.corrected, edge_objective, frames)
    chosen, corrected, candidates = greedy_search(found.corrected, search)
    video = VideoEdgeResult(
        score_before=mean_score(edge_objective.frame_scores(geometry)),
        score_after=mean_score(edge_objective.frame_scores(corrected)),
        candidates=candidates,
    )
    corrections = (*found.corrections, *chosen)
    return replace(found, corrections=corrections, corrected=corrected, video=video)


def _find_body_corrections(
    geometry: CaptureGeometry, objective: SilhouetteObjective, frames: int
) -> CorrectionResult:
    """The mistakes between body and masks; with a fitted camera where the others explain little."""
    search = _body_search(objective, frames)
    chosen, corrected, candidates = greedy_search(geometry, search)
    jumps = find_jumps(geometry)[0]
    fits = (fit_principal_point,) if jumps else (fit_principal_point, fit_extrinsics)
    for fit in fits:
        iou = mean_score(objective.frame_scores(corrected))
        explained = iou >= CAMERA_SEARCH_BELOW_IOU and len(chosen) < MAX_CORRECTIONS
        if explained or objective.are_boxes:
            break
        camera = fit(geometry, objective)
        if camera is None:
            continue
        others, better, _ = greedy_search(camera.apply(geometry), search)
        scores = objective.frame_scores(better)
        needed = GOOD_IOU if fit is fit_principal_point else USABLE_IOU
        gained = mean_score(scores) > max(needed, iou + CAMERA_SEARCH_MIN_GAIN)
        if gained and np.nanpercentile(scores, 10) > USABLE_IOU:  # not a compromise between two
            chosen, corrected = [camera, *others], better
            candidates = best_per_cause([*candidates, *evaluate([camera], geometry, objective)])
    return CorrectionResult(
        iou_before=mean_score(objective.frame_scores(geometry)),
        iou_after=mean_score(objective.frame_scores(corrected)),
        corrections=tuple(chosen),
        candidates=candidates,
        corrected=corrected,
    )


def _body_search(objective: SilhouetteObjective, frames: int) -> CorrectionSearch:
    """The search for mistakes between body and masks."""
    pelvis = objective.skin.shaped.joints[0]

    def refit(correction: Correction, geometry: CaptureGeometry) -> Correction:
        make = _factor_makers(pelvis)[correction.cause]
        change = fit_factor(make, geometry, objective, near_one=True).factor or 1.0
        return make((correction.factor or 1.0) * change)

    return CorrectionSearch(
        objective=objective,
        discrete=lambda geometry: body_corrections(geometry, pelvis, frames),
        fit_continuous=_fit_continuous,
        make_shift=undo_pose_delay,
        min_gain=MIN_IOU_GAIN,
        min_fitted_gain=MIN_FITTED_IOU_GAIN,
        min_fitted_change=MIN_FITTED_CHANGE,
        refit=refit,
    )


def video_search(
    geometry: CaptureGeometry, objective: EdgeObjective, frames: int, *, quick: bool = False
) -> CorrectionSearch:
    """The search for mistakes of the video alone.

    Args:
        geometry: Poses, masks and video as they are.
        objective: A few images and all masks.
        frames: Number of frames in the video.
        quick: Skips distant offsets and crops, which take long.
    """
    clear = quick or mean_score(objective.frame_scores(geometry)) >= CLEAR_EDGE_SCORE
    max_offset = NEAR_OFFSET_FRAMES if clear else max(frames, objective.mask_count)

    def crops(geometry: CaptureGeometry, few: EdgeObjective) -> list[Correction]:
        return [] if quick else [undo_video_crop(few.fit_window(geometry))]

    return CorrectionSearch(
        objective=objective,
        discrete=lambda _: video_corrections(frames, objective.mask_count, max_offset),
        fit_continuous=crops,
        make_shift=undo_video_offset,
        min_gain=MIN_EDGE_GAIN,
        min_fitted_gain=MIN_CROP_EDGE_GAIN,
        min_fitted_change=MIN_CROP_FRACTION,
        min_score=MIN_EDGE_SCORE,
    )


def needs_video_correction(
    geometry: CaptureGeometry, objective: EdgeObjective, frames: int
) -> bool:
    """Whether one of the likeliest mistakes of the video alone is significant; a quick check."""
    search = video_search(geometry, objective, frames, quick=True)
    scores = objective.frame_scores(geometry)
    candidates = evaluate(search.discrete(geometry), geometry, objective)
    return any(is_significant(each, geometry, scores, search) for each in candidates)


def _factor_makers(pelvis: Float[np.ndarray, "3"]) -> dict[str, Callable[[float], Correction]]:
    """Makers of the corrections between body and masks that have a size, by their cause."""
    return {
        "focal": scale_focal_length,
        "body_scale": lambda factor: divide_distances(factor, pelvis),
        "aspect": stretch_width,
    }


def _fit_continuous(geometry: CaptureGeometry, objective: SilhouetteObjective) -> list[Correction]:
    """The best focal length, the best size and the best aspect, each fitted alone."""
    if objective.are_boxes:
        return []
    pelvis = objective.skin.shaped.joints[0]
    return [fit_factor(make, geometry, objective) for make in _factor_makers(pelvis).values()]

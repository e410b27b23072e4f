"""Greedy search for the corrections of a capture that bring a significant gain in score."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.corrections import CAUSES, Correction
from preprocess.alignment.edge_objective import EdgeObjective
from preprocess.alignment.silhouette_objective import (
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
    if is_fitted and _relative_change(geometry, correction.apply(geometry)) < (
        search.min_fitted_change
    ):
        return False
    error = gains.std(ddof=1) / np.sqrt(len(gains)) if len(gains) > 1 else 0.0
    needed = search.min_fitted_gain if is_fitted else search.min_gain
    return bool(gains.mean() > max(needed, MIN_STANDARD_ERRORS * error))


def _relative_change(before: CaptureGeometry, after: CaptureGeometry) -> float:
    """Relative change of focal length, distance or window, whichever is largest."""
    focal = after.intrinsics[0, 0, 0] / before.intrinsics[0, 0, 0]
    translations, valid = before.motion.root_translations, before.motion.valid
    moved = np.linalg.norm((after.motion.root_translations - translations)[valid])
    distance = moved / max(float(np.linalg.norm(translations[valid])), 1e-9)
    window = np.abs(np.subtract(after.video_transform.window, before.video_transform.window)).max()
    return max(abs(float(np.log(focal))), float(distance), float(window))

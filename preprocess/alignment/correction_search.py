"""Find the mistakes that, undone, make body, masks and tracked key points agree.

A greedy search applies the best correction again and again while its gain in score is significant.
Key points choose the few candidates whose silhouettes are worth drawing.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from preprocess.alignment.capture_geometry import CaptureGeometry, relative_change
from preprocess.alignment.correction_catalog import body_corrections, video_corrections
from preprocess.alignment.corrections import (
    CAUSES,
    Correction,
    fit_to_keypoints,
    undo_pose_delay,
    undo_video_offset,
)
from preprocess.alignment.keypoint_objective import KeypointObjective
from preprocess.alignment.silhouette_objective import (
    SilhouetteObjective,
    mean_score,
    mean_with_missing,
)

MIN_STANDARD_ERRORS = 3.0
"""Standard errors, over the frames, by which a gain must exceed 0."""
MAX_LOST_FRACTION = 0.3
"""Fraction of the frames with poses that a correction may leave without; more count as score 0."""
MAX_CORRECTIONS = 3
"""Corrections that are named at most."""
COARSE_SAMPLES = 6
"""Masks in which every candidate is scored where there are no key points."""
MAX_CANDIDATES = 8
"""Best candidates of the coarse scores that are scored in all frames."""
TIE_SCORE = 0.004
"""Scores this close are equal; then the cause that stands first in `CAUSES` is named."""
MIN_GAIN = 0.02
"""Gain in score that a discrete correction must bring."""
MIN_FITTED_GAIN = 0.04
"""Gain in score that a fitted correction must bring: clothes make every body a little larger."""
MIN_FITTED_CHANGE = 0.06
"""Relative change of its number that a fitted correction must make."""
MIN_EXPLAINED_SCORE = 0.5
"""Score after all corrections below which they explain nothing, and none is named."""
MIN_WINDOW_CHANGE = 0.02
"""Fraction of the image that a video must be cropped or padded by."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptureObjective:
    """Scores a geometry by masks and key points of a few frames.

    `masks` is None without masks; `keypoints` is None if no person was found in the images.
    """

    masks: SilhouetteObjective | None
    keypoints: KeypointObjective | None

    def frame_scores(self, geometry: CaptureGeometry) -> Float[np.ndarray, "samples"]:
        """IoU of each mask, then score of each image's key points; NaN where there is no pose."""
        parts = [each for each in (self.masks, self.keypoints) if each is not None]
        return np.concatenate([np.zeros(0), *(each.frame_scores(geometry) for each in parts)])

    def coarse_score(self, geometry: CaptureGeometry) -> float:
        """Mean score of the key points; without any, IoU of a few masks."""
        if self.keypoints is not None:
            return mean_with_missing(self.keypoints.frame_scores(geometry))
        if self.masks is None:
            return 0.0
        return mean_with_missing(self.masks.subset(COARSE_SAMPLES).frame_scores(geometry))


@dataclass(frozen=True, eq=False, kw_only=True)
class CorrectionCandidate:
    """A correction and the score it would bring: the mean, and that of each frame."""

    correction: Correction
    mean_score: float
    frame_scores: Float[np.ndarray, "samples"]


@dataclass(frozen=True, eq=False, kw_only=True)
class CorrectionResult:
    """The mistakes found in a capture, and the geometry without them.

    Attributes:
        corrections: The corrections, the one with the largest gain first.
        candidates: The best candidate of each cause in the first round, best first.
    """

    corrections: tuple[Correction, ...]
    candidates: tuple[CorrectionCandidate, ...]
    corrected: CaptureGeometry


@dataclass(frozen=True, eq=False, kw_only=True)
class CorrectionSearch:
    """The corrections that are tried, and their scores.

    Attributes:
        pelvis: Rest position of the pelvis.
        mask_count: Number of masks; 0 if images and masks cannot disagree.
    """

    objective: CaptureObjective
    pelvis: Float[np.ndarray, "3"]
    frames: int
    mask_count: int

    def run(self, geometry: CaptureGeometry) -> CorrectionResult:
        """Apply the best correction again and again while that helps significantly."""
        stored = geometry
        scores = self.objective.frame_scores(geometry)
        chosen: list[Correction] = []
        first: tuple[CorrectionCandidate, ...] = ()
        while len(chosen) < MAX_CORRECTIONS:
            candidates = self._best_candidates(geometry)
            first = first if chosen else best_per_cause(candidates)
            candidates = [c for c in candidates if is_significant(c, geometry, scores)]
            if not candidates:
                break
            best = max(candidate.mean_score for candidate in candidates)
            tied = [each for each in candidates if each.mean_score > best - TIE_SCORE]
            winner = min(tied, key=lambda each: CAUSES.index(each.correction.cause))
            chosen.append(winner.correction)
            geometry, scores = winner.correction.apply(geometry), winner.frame_scores
        if mean_score(scores) < MIN_EXPLAINED_SCORE:
            chosen, geometry = [], stored
        return CorrectionResult(corrections=tuple(chosen), candidates=first, corrected=geometry)

    def _best_candidates(self, geometry: CaptureGeometry) -> list[CorrectionCandidate]:
        """The best candidates of the coarse scores, and the best of each cause, scored wholly."""
        scored = self._score_coarsely(self._discrete(geometry), geometry)
        for cause, make in (("frame_offset", undo_pose_delay), ("video_offset", undo_video_offset)):
            shifts = [(score, c.frame_shift) for score, c in scored if c.cause == cause]
            center = max(((s, k) for s, k in shifts if k is not None), default=(0.0, 0))[1]
            reach = max(1, abs(center) // 5) if shifts else 0
            near = [make(center + k) for k in range(-reach, reach + 1) if k and center + k]
            scored += self._score_coarsely(near, geometry)
        scored += self._score_coarsely(self._fitted(geometry), geometry)
        scored.sort(key=lambda pair: -pair[0])
        kept = [correction for _, correction in scored[:MAX_CANDIDATES]]
        for _, correction in scored[MAX_CANDIDATES:]:
            if correction.cause not in {each.cause for each in kept}:
                kept.append(correction)
        return evaluate(kept, geometry, self.objective)

    def _score_coarsely(
        self, corrections: Iterable[Correction], geometry: CaptureGeometry
    ) -> list[tuple[float, Correction]]:
        return [(self.objective.coarse_score(each.apply(geometry)), each) for each in corrections]

    def _discrete(self, geometry: CaptureGeometry) -> Iterable[Correction]:
        yield from body_corrections(geometry, self.pelvis, self.frames)
        if self.mask_count and self.objective.keypoints is not None:
            yield from video_corrections(self.frames, self.mask_count)

    def _fitted(self, geometry: CaptureGeometry) -> Iterable[Correction]:
        """The best focal length, principal point, size, aspect and window of the video."""
        if self.objective.keypoints is None:  # outlines alone would fit wide clothes
            return ()
        fitted = fit_to_keypoints(geometry, self.objective.keypoints)
        return (c for c in fitted if self.mask_count or c.cause != "video_crop")


def evaluate(
    corrections: Iterable[Correction], geometry: CaptureGeometry, objective: CaptureObjective
) -> list[CorrectionCandidate]:
    """Score each correction, applied to the geometry alone."""
    scored = [(each, objective.frame_scores(each.apply(geometry))) for each in corrections]
    return [
        CorrectionCandidate(correction=each, mean_score=mean_with_missing(s), frame_scores=s)
        for each, s in scored
    ]


def best_per_cause(candidates: Iterable[CorrectionCandidate]) -> tuple[CorrectionCandidate, ...]:
    """The best candidate of each cause, best first."""
    best: dict[str, CorrectionCandidate] = {}
    for each in sorted(candidates, key=lambda each: -each.mean_score):
        best.setdefault(each.correction.cause, each)
    return tuple(best.values())


def is_significant(
    candidate: CorrectionCandidate, geometry: CaptureGeometry, scores: Float[np.ndarray, "samples"]
) -> bool:
    """Check whether a candidate gains enough, frame by frame, over the current scores."""
    gains = candidate.frame_scores - np.nan_to_num(scores)
    had, has = np.isfinite(scores), np.isfinite(candidate.frame_scores)
    if had.sum() - has.sum() > MAX_LOST_FRACTION * had.sum():
        # It would explain some frames by giving up others: those count as lost.
        gains = np.where(had & ~has, -np.nan_to_num(scores), gains)
    gains = gains[np.isfinite(gains)]
    if 2 * len(gains) < len(scores):
        return False
    correction = candidate.correction
    is_fitted = correction.factor is not None
    least = MIN_WINDOW_CHANGE if correction.cause == "video_crop" else MIN_FITTED_CHANGE
    if is_fitted and relative_change(geometry, correction.apply(geometry)) < least:
        return False
    error = gains.std(ddof=1) / np.sqrt(len(gains)) if len(gains) > 1 else 0.0
    needed = MIN_FITTED_GAIN if is_fitted else MIN_GAIN
    return bool(gains.mean() > max(needed, MIN_STANDARD_ERRORS * error))

"""Find the mistakes that, undone, make body, masks and images agree."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from preprocess.alignment.capture_geometry import CaptureGeometry, find_jumps
from preprocess.alignment.correction_catalog import body_corrections, video_corrections
from preprocess.alignment.corrections import (  # fmt: skip
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
from preprocess.alignment.greedy_search import (
    MAX_CORRECTIONS,
    CorrectionCandidate,
    CorrectionSearch,
    best_per_cause,
    evaluate,
    greedy_search,
    is_significant,
)
from preprocess.alignment.silhouette_objective import (
    SilhouetteObjective,
    mean_score,
)

GOOD_IOU = 0.7
"""Mean IoU of body and masks from which a capture is good."""
USABLE_IOU = 0.5
"""Mean IoU below which a capture cannot be trained on."""
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
FITTED_CAUSES = ("focal", "body_scale", "aspect")
"""Mistakes between body and masks that have a size."""
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
        make = _correction_factory(correction.cause, pelvis)
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


def _correction_factory(
    cause: str, pelvis: Float[np.ndarray, "3"]
) -> Callable[[float], Correction]:
    """Makes corrections of one of `FITTED_CAUSES` from their factor."""
    if cause == "focal":
        return scale_focal_length
    if cause == "aspect":
        return stretch_width
    return lambda factor: divide_distances(factor, pelvis)


def _fit_continuous(geometry: CaptureGeometry, objective: SilhouetteObjective) -> list[Correction]:
    """The best focal length and the best size, each fitted alone."""
    if objective.are_boxes:
        return []
    pelvis = objective.skin.shaped.joints[0]
    return [
        fit_factor(_correction_factory(cause, pelvis), geometry, objective)
        for cause in FITTED_CAUSES
    ]

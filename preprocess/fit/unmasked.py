"""A body fitted to pictures without masks: masks are found around it, it is fitted to them, again.

At first it may stand off by a fifth of its size. So much around its outline is in doubt: GrabCutSegmenter
(Rother et al. 2004) tells by colours who is person there. The body is fitted to these masks, less
is in doubt around the fitted one, and so on until it stands. Masks of this kind follow the body;
whether it found a person is asked of the pictures' edges.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from preprocess.doctor.claim import CaptureGeometry
from preprocess.doctor.evidence import SilhouetteObjective, MaskSample
from preprocess.fit.pictures import BodyOutline, ImageSample, body_outline, edge_contrast
from preprocess.fit.refit import BodyPlacement, place_body_on_masks
from preprocess.silhouette import SkinPoints

UNCERTAIN_BANDS_M = (0.12, 0.05, 0.035)
"""How far inside and outside of the body's outline pixels are in doubt, round after round."""
MAX_INNER_BAND = 0.6
"""Pixels this deep in the body (as a share of the deepest) are person for sure, at the least."""
CLOTHING_GUESS_M = 0.01
"""How far clothes stand off, as a guess."""
BACKGROUND_BORDER_M = 0.25
"""How much of the background is looked at."""
GRABCUT_ITERATIONS = 2
MAX_ROUNDS, CONVERGED_DISTANCE, CONVERGED_SHIFT_M = 6, 0.005, 0.003
"""Rounds at most; the body stands if a round changes its distance and its place by less."""


def place_body_on_images(geometry: CaptureGeometry, skin: SkinPoints, samples: Sequence[ImageSample]) -> BodyPlacement:
    """Fits SMPL's poses to another body with a few pictures.

    Args:
        claim: Poses and cameras; the body may be off by a fifth of its size, or of its place.
        skin: The body.
        pictures: See `sample_video`.
    """
    nearer, shift_m, evidence, now = 1.0, np.zeros(3), None, geometry
    for number in range(MAX_ROUNDS):
        found = _estimate_masks(now, skin, samples, UNCERTAIN_BANDS_M[min(number, len(UNCERTAIN_BANDS_M) - 1)])
        if found is None:
            break
        evidence = found
        step = place_body_on_masks(now, evidence)
        now = replace(now, motion=step.motion)
        nearer, shift_m = nearer * step.distance_divisor, shift_m / step.distance_divisor + step.pelvis_shift_m
        stands = abs(step.distance_divisor - 1.0) < CONVERGED_DISTANCE and np.linalg.norm(step.pelvis_shift_m) < CONVERGED_SHIFT_M
        if number + 1 >= len(UNCERTAIN_BANDS_M) and stands:
            break
    return BodyPlacement(
        motion=now.motion,
        iou_before=_mean_iou(geometry, evidence),
        iou_after=_mean_iou(now, evidence),
        distance_divisor=nearer,
        pelvis_shift_m=shift_m,
        edge_contrast=(edge_contrast(geometry, skin, samples), edge_contrast(now, skin, samples)),
    )


def _mean_iou(claim: CaptureGeometry, evidence: SilhouetteObjective | None) -> float:
    scores = np.zeros(0) if evidence is None else evidence.frame_scores(claim)
    known = scores[np.isfinite(scores)]
    return float(known.mean()) if len(known) else 0.0


def _estimate_masks(
    claim: CaptureGeometry, skin: SkinPoints, samples: Sequence[ImageSample], band_m: float
) -> SilhouetteObjective | None:
    """The masks of all pictures in which the body is; None if it is in none."""
    witnesses = []
    for picture in samples:
        body = body_outline(claim, skin, picture)
        person = None if body is None else grabcut_near_outline(picture.rgb, body, band_m)
        if person is not None:
            alpha = person.astype(np.float32)
            row = picture.camera_row
            witnesses.append(MaskSample(index=picture.index, camera_row=row, alpha=alpha))
    return SilhouetteObjective(samples=tuple(witnesses), skin=skin) if witnesses else None


def grabcut_near_outline(
    rgb: UInt8[np.ndarray, "height width 3"], outline: BodyOutline, band_m: float
) -> Bool[np.ndarray, "height width"] | None:
    """Who is person in a picture, among the pixels near a body's outline; None if that fails.

    Args:
        rgb: The picture.
        body: Where the body is, roughly.
        band_m: How far inside and outside pixels are in doubt, if limbs are not thinner.
    """
    away = outline.signed_distance_m - np.float32(CLOTHING_GUESS_M)
    inwards = min(band_m, MAX_INNER_BAND * float(-away.min()))
    labels = np.where(away < 0.0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[away >= band_m], labels[away <= -inwards] = cv2.GC_BGD, cv2.GC_FGD
    rows, columns = np.nonzero(away < band_m)
    if not len(rows):
        return None
    margin = int(BACKGROUND_BORDER_M * outline.px_per_m) + 1
    box = (
        slice(max(0, int(rows.min()) - margin), int(rows.max()) + margin + 1),
        slice(max(0, int(columns.min()) - margin), int(columns.max()) + margin + 1),
    )
    part = np.ascontiguousarray(labels[box])
    if not (part & 1).any() or (part & 1).all():
        return None
    cv2.setRNGSeed(0)
    models, bgr = (np.zeros((1, 65)), np.zeros((1, 65))), np.ascontiguousarray(rgb[box][..., ::-1])
    cv2.grabCut(bgr, part, (0, 0, 1, 1), *models, GRABCUT_ITERATIONS, cv2.GC_INIT_WITH_MASK)
    person = np.zeros(away.shape, dtype=bool)
    person[box] = (part & 1) > 0
    return person if person.any() else None

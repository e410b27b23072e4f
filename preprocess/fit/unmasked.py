"""A body fitted to pictures without masks: masks are found around it, it is fitted to them, again.

At first it may stand off by a fifth of its size. So much around its outline is in doubt: GrabCut
(Rother et al. 2004) tells by colours who is person there. The body is fitted to these masks, less
is in doubt around the fitted one, and so on until it stands. Masks of this kind follow the body;
whether it found a person is asked of the pictures' edges.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from preprocess.doctor.claim import Claim
from preprocess.doctor.evidence import Evidence, Witness
from preprocess.fit.pictures import Drawn, Picture, drawn, edges
from preprocess.fit.refit import Refit, refitted
from preprocess.silhouette import SkinPoints

BANDS_M = (0.12, 0.05, 0.035)
"""How far inside and outside of the body's outline pixels are in doubt, round after round."""
DEEPEST = 0.6
"""Pixels this deep in the body (as a share of the deepest) are person for sure, at the least."""
CLOTHES_M = 0.01
"""How far clothes stand off, as a guess."""
AROUND_M = 0.25
"""How much of the background is looked at."""
ROUNDS = 2
MOST, STANDS, STANDS_M = 6, 0.005, 0.003
"""Rounds at most; the body stands if a round changes its distance and its place by less."""


def fitted_to_pictures(claim: Claim, skin: SkinPoints, pictures: Sequence[Picture]) -> Refit:
    """Fits SMPL's poses to another body with a few pictures.

    Args:
        claim: Poses and cameras; the body may be off by a fifth of its size, or of its place.
        skin: The body.
        pictures: See `glance`.
    """
    nearer, shift_m, evidence, now = 1.0, np.zeros(3), None, claim
    for number in range(MOST):
        found = _masks(now, skin, pictures, BANDS_M[min(number, len(BANDS_M) - 1)])
        if found is None:
            break
        evidence = found
        step = refitted(now, evidence)
        now = replace(now, motion=step.motion)
        nearer, shift_m = nearer * step.nearer, shift_m / step.nearer + step.shift_m
        stands = abs(step.nearer - 1.0) < STANDS and np.linalg.norm(step.shift_m) < STANDS_M
        if number + 1 >= len(BANDS_M) and stands:
            break
    return Refit(
        motion=now.motion,
        before=_agreement(claim, evidence),
        after=_agreement(now, evidence),
        nearer=nearer,
        shift_m=shift_m,
        edges=(edges(claim, skin, pictures), edges(now, skin, pictures)),
    )


def _agreement(claim: Claim, evidence: Evidence | None) -> float:
    scores = np.zeros(0) if evidence is None else evidence.scores(claim)
    known = scores[np.isfinite(scores)]
    return float(known.mean()) if len(known) else 0.0


def _masks(
    claim: Claim, skin: SkinPoints, pictures: Sequence[Picture], band_m: float
) -> Evidence | None:
    """The masks of all pictures in which the body is; None if it is in none."""
    witnesses = []
    for picture in pictures:
        body = drawn(claim, skin, picture)
        person = None if body is None else person_near(picture.rgb, body, band_m)
        if person is not None:
            alpha = person.astype(np.float32)
            row = picture.camera_row
            witnesses.append(Witness(index=picture.index, camera_row=row, alpha=alpha))
    return Evidence(witnesses=tuple(witnesses), skin=skin) if witnesses else None


def person_near(
    rgb: UInt8[np.ndarray, "height width 3"], body: Drawn, band_m: float
) -> Bool[np.ndarray, "height width"] | None:
    """Who is person in a picture, among the pixels near a body's outline; None if that fails.

    Args:
        rgb: The picture.
        body: Where the body is, roughly.
        band_m: How far inside and outside pixels are in doubt, if limbs are not thinner.
    """
    away = body.away_m - np.float32(CLOTHES_M)
    inwards = min(band_m, DEEPEST * float(-away.min()))
    labels = np.where(away < 0.0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[away >= band_m], labels[away <= -inwards] = cv2.GC_BGD, cv2.GC_FGD
    rows, columns = np.nonzero(away < band_m)
    if not len(rows):
        return None
    margin = int(AROUND_M * body.px_per_m) + 1
    box = (
        slice(max(0, int(rows.min()) - margin), int(rows.max()) + margin + 1),
        slice(max(0, int(columns.min()) - margin), int(columns.max()) + margin + 1),
    )
    part = np.ascontiguousarray(labels[box])
    if not (part & 1).any() or (part & 1).all():
        return None
    cv2.setRNGSeed(0)
    models, bgr = (np.zeros((1, 65)), np.zeros((1, 65))), np.ascontiguousarray(rgb[box][..., ::-1])
    cv2.grabCut(bgr, part, (0, 0, 1, 1), *models, ROUNDS, cv2.GC_INIT_WITH_MASK)
    person = np.zeros(away.shape, dtype=bool)
    person[box] = (part & 1) > 0
    return person if person.any() else None

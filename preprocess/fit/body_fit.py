"""Poses brought to the body that is really used: another than their tracker's, or the avatar's own.

Without SMPL's file, SMPL's poses move the embedded body; and poses that are added to a finished
avatar move the person that it has, whatever their betas say. Rotations stay as they are; distance
and place are solved anew from masks, or, where there are none, from the pictures themselves.
"""

from dataclasses import dataclass

import numpy as np

from capture.errors import BadInput
from capture.source import Source
from preprocess.body import ShapedBody
from preprocess.camera_file import CameraTrack
from preprocess.doctor.claim import Claim
from preprocess.doctor.evidence import Evidence, gather
from preprocess.fit.pictures import glance
from preprocess.fit.refit import FRAMES, Refit, refitted
from preprocess.fit.stature import farther, height_of
from preprocess.fit.unmasked import fitted_to_pictures
from preprocess.masks.files import Masks
from preprocess.observe import check_cameras, check_masks
from preprocess.pose import Motion
from preprocess.silhouette import SkinPoints

BETTER = 0.02
"""By how much the body's own proportions must fit better than SMPL's to be taken instead."""
SAME_M = 5e-4
"""Bodies whose resting skin is nowhere farther apart are one."""
TOLD_M = 0.01
"""Differences in height, or of a joint from the pelvis, that are spoken of."""
SOMEBODY_ELSE = 0.08
"""Difference in height, as a share, beyond which it may not be the same person."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyFit:
    """A person and poses that belong together.

    Attributes:
        shaped: The person's body.
        motion: The poses, for this body.
        words: What was done, for people; empty if nothing was.
        refit: What was found in the masks, if something was looked for.
    """

    shaped: ShapedBody
    motion: Motion
    words: str = ""
    refit: Refit | None = None


def is_foreign(motion: Motion, shaped: ShapedBody) -> bool:
    """Whether poses were made for a body model whose size nobody knows here."""
    return shaped.body.family not in ("smpl", motion.model)


def fit_body(
    motion: Motion,
    shaped: ShapedBody,
    cameras: CameraTrack,
    source: Source,
    masks: Masks | None,
) -> BodyFit:
    """Body and motion as they fit the masks, if the tracker had another body in mind.

    The body's own mean proportions are tried beside SMPL's; they are taken if they fit better by
    `BETTER`: files say SMPL of poses that were fitted to something else.

    Args:
        motion: In the cameras' world.
        shaped: The body that is used, with SMPL's mean joints (`shaped_for`).
        cameras: Of the frames' size.
        source: The frames; few are decoded, and none if there are masks in files.
        masks: The masks; None if the pictures have an alpha channel, or nobody knows any.
    """
    if not is_foreign(motion, shaped):
        return BodyFit(shaped=shaped, motion=motion)
    claim = Claim.of(motion, cameras, source)
    if masks is None and not source.has_alpha:
        seen = seen_in_pictures(claim, shaped, cameras, source)
        fit = BodyFit(shaped=shaped, motion=motion)
        return fit if seen is None else _taken(seen, shaped, motion)
    evidence = evidence_of(shaped, cameras, source, masks)
    if evidence is None:
        return BodyFit(shaped=shaped, motion=motion)
    refit = refitted(claim, evidence)
    own = shaped.body.with_shape()
    other = refitted(claim, _of(evidence, own))
    if other.worth_it and other.after > refit.after + BETTER:
        words = f"{other.in_words()} Its own proportions fit better than SMPL's."
        return BodyFit(shaped=own, motion=other.motion, words=words, refit=other)
    return _taken(refit, shaped, motion)


def fit_to_person(
    motion: Motion,
    shaped: ShapedBody,
    person: ShapedBody,
    cameras: CameraTrack,
    source: Source,
    masks: Masks | None,
) -> BodyFit:
    """The motion for the person that an avatar has, which never changes.

    Args:
        motion: In the cameras' world, for the body `shaped`.
        shaped: The person that these poses' tracker had in mind.
        person: The avatar's.
        cameras, source, masks: As in `fit_body`.
    """
    foreign, same = is_foreign(motion, shaped), are_alike(person, shaped)
    if same and not foreign:
        return BodyFit(shaped=person, motion=motion)
    masked = masks is not None or source.has_alpha
    evidence = evidence_of(person, cameras, source, masks) if masked else None
    claim = Claim.of(motion, cameras, source)
    if not same and not (foreign and evidence is not None):
        motion = farther(claim, shaped, person)
        claim = Claim.of(motion, cameras, source)
    told = "" if foreign or same else _compared(shaped, person)
    refit = None
    if evidence is not None:
        refit = refitted(claim, evidence)
    elif foreign and not masked:
        refit = seen_in_pictures(claim, person, cameras, source)
    if refit is None:
        return BodyFit(shaped=person, motion=motion, words=told)
    return _taken(refit, person, motion, told)


def are_alike(a: ShapedBody, b: ShapedBody) -> bool:
    """Whether two shapes of one body are the same person."""
    same = a.vertices.shape == b.vertices.shape
    return same and all(
        bool(np.abs(one - other).max() < SAME_M)
        for one, other in ((a.vertices, b.vertices), (a.joints, b.joints))
    )


def _taken(refit: Refit, shaped: ShapedBody, motion: Motion, told: str = "") -> BodyFit:
    """The refit, if it is worth it."""
    return BodyFit(
        shaped=shaped,
        motion=refit.motion if refit.worth_it else motion,
        words=f"{told} {refit.in_words()}".strip(),
        refit=refit,
    )


def _compared(shaped: ShapedBody, person: ShapedBody) -> str:
    """How the body that poses were made for differs from the avatar's; empty if it hardly does."""
    theirs, ours = height_of(shaped), height_of(person)
    off = (shaped.joints - shaped.joints[0]) - (person.joints - person.joints[0])
    apart = float(np.linalg.norm(off, axis=1).max())
    if abs(theirs - ours) < TOLD_M and apart < TOLD_M:
        return ""
    doubt = " Is it the same person?" if abs(theirs / ours - 1.0) > SOMEBODY_ELSE else ""
    return (
        f"Their betas state a body of {100.0 * theirs:.0f} cm, the avatar's has "
        f"{100.0 * ours:.0f} cm (joints up to {100.0 * apart:.1f} cm elsewhere): the avatar keeps "
        f"its own, and these poses follow.{doubt}"
    )


def seen_in_pictures(
    claim: Claim, shaped: ShapedBody, cameras: CameraTrack, source: Source
) -> Refit | None:
    """The body fitted to a few pictures; None where parts do not fit, which is said elsewhere."""
    skin = SkinPoints.of(shaped)
    try:
        pictures = glance(claim, skin, cameras, source)
    except BadInput:
        return None
    return fitted_to_pictures(claim, skin, pictures)


def evidence_of(
    shaped: ShapedBody, cameras: CameraTrack, source: Source, masks: Masks | None
) -> Evidence | None:
    """A few masks; None where parts do not fit or show nobody, which is said elsewhere."""
    try:
        rows = check_masks(masks, source), check_cameras(cameras, source)
        return gather(
            source, masks, *rows, SkinPoints.of(shaped), count=FRAMES, without=cameras.missing
        )
    except BadInput:
        return None


def _of(evidence: Evidence, shaped: ShapedBody) -> Evidence:
    """The same masks, for another person."""
    return Evidence(witnesses=evidence.witnesses, skin=SkinPoints.of(shaped))

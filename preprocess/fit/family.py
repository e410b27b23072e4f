"""Whose body poses were made for, where their file does not say: masks or pictures are asked."""

from dataclasses import replace

from capture.errors import BadInput
from capture.source import Source
from preprocess.body import Body
from preprocess.camera_file import CameraTrack
from preprocess.doctor.claim import Claim
from preprocess.doctor.diagnosis import GOOD, mean
from preprocess.fit.body_fit import evidence_of
from preprocess.fit.pictures import edges, glance
from preprocess.fit.refit import EDGES, refitted
from preprocess.fit.unmasked import fitted_to_pictures
from preprocess.masks.files import Masks
from preprocess.pose import Motion
from preprocess.poses.place import placed
from preprocess.shape import shaped_for
from preprocess.silhouette import SkinPoints

CLEARLY = 0.05
"""By how much SMPL's body must agree better with the masks to be taken."""
SHARPER = 1.1
"""Without masks: how many times more it must stand out from what is beside it in the pictures."""


def with_family(
    read: Motion,
    body: Body,
    cameras: CameraTrack,
    source: Source,
    masks: Masks | None,
    *,
    cameras_given: bool,
) -> Motion:
    """The motion as it was read, called SMPL's if its file is silent and the masks say so.

    InstantAvatar and its successors write SMPL's poses without naming the body; what this project
    writes names it. Betas of one body make nonsense of another.

    Args:
        read: As `read_poses` gives it.
        body: The one that is used.
        cameras, source, masks: See `fit_body`.
        cameras_given: See `placed`.
    """
    if read.model_said or body.family == "smpl":
        return read
    if masks is None and not source.has_alpha:
        return _by_pictures(read, body, cameras, source, cameras_given=cameras_given)
    after = {}
    for model in (read.model, "smpl"):
        motion = replace(read, model=model)
        shaped = shaped_for(body, motion)
        motion = placed(motion, shaped, cameras, cameras_given=cameras_given)
        evidence = evidence_of(shaped, cameras, source, masks)
        if evidence is None:
            return read
        claim = Claim.of(motion, cameras, source)
        if model == read.model and mean(evidence.scores(claim)) >= GOOD:
            return read
        after[model] = refitted(claim, evidence).after
    if after["smpl"] < after[read.model] + CLEARLY:
        return read
    found = f"with which masks agree by {after['smpl']:.2f} (else {after[read.model]:.2f})"
    return _taken_for_smpls(read, found)


def _by_pictures(
    read: Motion, body: Body, cameras: CameraTrack, source: Source, *, cameras_given: bool
) -> Motion:
    """The same where there are no masks: by how the pictures' edges run along the body."""
    stands_out = {}
    for model in (read.model, "smpl"):
        motion = replace(read, model=model)
        shaped = shaped_for(body, motion)
        motion = placed(motion, shaped, cameras, cameras_given=cameras_given)
        claim, skin = Claim.of(motion, cameras, source), SkinPoints.of(shaped)
        try:
            pictures = glance(claim, skin, cameras, source)
        except BadInput:
            return read
        if model == read.model:
            stands_out[model] = edges(claim, skin, pictures)
        else:
            fitted = fitted_to_pictures(claim, skin, pictures)
            stands_out[model] = edges(replace(claim, motion=fitted.motion), skin, pictures)
    if stands_out["smpl"] < SHARPER * max(stands_out[read.model], EDGES):
        return read
    found = (
        f"whose outline stands out {stands_out['smpl']:.1f} times from what is beside it in the "
        f"pictures (else {stands_out[read.model]:.1f} times)"
    )
    return _taken_for_smpls(read, found)


def _taken_for_smpls(read: Motion, found: str) -> Motion:
    said = (
        "The poses' file does not say for which body they were made (`model`); they are taken for "
        f"SMPL's, {found}."
    )
    note = said if read.note is None else f"{read.note} {said}"
    return replace(read, model="smpl", note=note)

"""Whose body poses were made for, where their file does not say: masks are asked."""

from dataclasses import replace

from capture.source import Source
from preprocess.body import Body
from preprocess.camera_file import CameraTrack
from preprocess.doctor.claim import Claim
from preprocess.doctor.diagnosis import GOOD, mean
from preprocess.fit.body_fit import evidence_of
from preprocess.fit.refit import refitted
from preprocess.masks.files import Masks
from preprocess.pose import Motion
from preprocess.poses.place import placed
from preprocess.shape import shaped_for

CLEARLY = 0.05
"""By how much SMPL's body must agree better with the masks to be taken."""


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
    if read.model_said or body.family == "smpl" or (masks is None and not source.has_alpha):
        return read
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
    said = (
        "The poses' file does not say for which body they were made (`model`); they are taken for "
        f"SMPL's, with which masks agree by {after['smpl']:.2f} (else {after[read.model]:.2f})."
    )
    note = said if read.note is None else f"{read.note} {said}"
    return replace(read, model="smpl", note=note)

"""Alignment of a capture: the poses' body model, their placement, and an unknown focal length.

Poses may be for another body than the one that is used: without SMPL's file SMPL's poses move the
embedded body, and poses that are added to a finished avatar move its own person, whatever their
betas state. Rotations stay; distance and pelvis shift are fitted to masks; without any, to masks
that are estimated. Where a file does not state the body model of its poses, the better fit decides.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from capture.input_error import InputError
from preprocess.alignment.capture_evidence import CaptureEvidence
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.correction_search import MIN_FITTED_CHANGE, MIN_FITTED_GAIN
from preprocess.alignment.corrections import fit_factor, scale_focal_length
from preprocess.alignment.mask_alignment import (
    ALIGNMENT_SAMPLES,
    BodyPlacement,
    body_height_m,
    place_body_on_masks,
    rescale_motion,
    scale_to_height,
)
from preprocess.alignment.silhouette_objective import GOOD_IOU, SilhouetteObjective, mean_score
from preprocess.body.body_pose import Motion
from preprocess.body.body_surface import SkinPoints
from preprocess.body.parametric_body import BodyModel, ShapedBody, read_shaped_body
from preprocess.body.proportion_space import shape_for_motion
from preprocess.cameras.camera_file import CameraTrack
from preprocess.masks.mask_sources import StoredMasks
from preprocess.poses.motion_builder import place_in_camera_world

FOCAL_SAMPLES = 6
"""Frames to whose masks a focal length is fitted."""
MIN_FOCAL_IOU = 0.6
"""Mean IoU of body and masks from which a fitted focal length is taken."""
HEIGHT_TOLERANCE_CM = 1.5
"""Largest difference between a stated height and the avatar's own, centimetres."""


def estimate_focal_length(
    evidence: CaptureEvidence, motion: Motion, shaped: ShapedBody
) -> CameraTrack:
    """Fit the focal length of an assumed camera so that the body covers the masks.

    The evidence holds that one camera (`assume_static_camera`). Its focal length changes only if
    another fits clearly better; without mask files it stays, and for poses of another body model:
    their size and the focal length are ambiguous.
    """
    cameras, geometry = evidence.cameras, evidence.geometry(motion)
    of_files = isinstance(evidence.masks, StoredMasks)
    if not of_files or motion.body_model != shaped.body.family:
        return cameras
    objective = evidence.silhouettes(SkinPoints.of(shaped), geometry, FOCAL_SAMPLES)
    if objective is None:
        return cameras
    scale = fit_factor(scale_focal_length, geometry, objective)
    factor = scale.factor or 1.0
    before = mean_score(objective.frame_scores(geometry))
    after = mean_score(objective.frame_scores(scale.apply(geometry)))
    is_better = after >= max(MIN_FOCAL_IOU, before + MIN_FITTED_GAIN)
    if not is_better or abs(factor - 1.0) < MIN_FITTED_CHANGE:
        return cameras
    usual = cameras[0].focal_px[0]
    return replace(
        cameras.scale_focal(factor),
        source="focal length found from the masks",
        note=f"No camera was given; a focal length of {factor * usual:.0f} px was found from the "
        f"masks: with it they agree with the body by {after:.2f}, with the usual {usual:.0f} px by "
        f"{before:.2f}.",
    )


MIN_OWN_SHAPE_GAIN = 0.02
"""Gain in mean IoU by which the body's own proportions must beat SMPL's."""
SAME_SHAPE_M = 5e-4
"""Largest distance between the resting surfaces of bodies that are the same, metres."""
REPORTED_DIFFERENCE_M = 0.01
"""Least difference in height, or of a joint relative to the pelvis, that is reported, metres."""
MAX_HEIGHT_DIFFERENCE = 0.08
"""Relative difference in height beyond which it may not be the same person."""
NO_PERSON_FOUND = (
    "There are no masks, and where the poses put the body no person was found in the images; "
    "distances stay as they are. Do poses and video belong together? Give --masks, from which "
    "ia-check can find what is wrong, or your own SMPL file (--body)."
)
"""Note about a capture in which no masks can be estimated."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyAlignment:
    """A person and poses that belong together.

    Attributes:
        description: Changes that were made, for people; empty if none were.
        placement: The fitted placement; None if none was attempted.
    """

    shaped: ShapedBody
    motion: Motion
    description: str = ""
    placement: BodyPlacement | None = None


def needs_placement(motion: Motion, shaped: ShapedBody) -> bool:
    """Check whether poses were made for a body model whose size is unknown here."""
    return shaped.body.family not in ("smpl", motion.body_model)


def align_body(motion: Motion, shaped: ShapedBody, evidence: CaptureEvidence) -> BodyAlignment:
    """Align body and motion to the masks, if the poses are of another body model.

    `shaped` is the body that is used, with SMPL's mean joints (`shape_for_motion`). Its own mean
    proportions are tried beside these and taken if they fit better by `MIN_OWN_SHAPE_GAIN`: files
    state SMPL for poses that were fitted to another body.
    """
    if not needs_placement(motion, shaped):
        return BodyAlignment(shaped=shaped, motion=motion)
    geometry = evidence.geometry(motion)
    objective = evidence.silhouettes(SkinPoints.of(shaped), geometry, ALIGNMENT_SAMPLES)
    if objective is None:
        return _accept(None, shaped, motion, "" if evidence.has_masks else NO_PERSON_FOUND)
    placement = place_body_on_masks(geometry, objective)
    own = shaped.body.with_shape()
    other = place_body_on_masks(geometry, _with_body(objective, own))
    if other.is_improvement and other.iou_after > placement.iou_after + MIN_OWN_SHAPE_GAIN:
        words = f"{other.describe()} Its own proportions fit better than SMPL's."
        return BodyAlignment(shaped=own, motion=other.motion, description=words, placement=other)
    return _accept(placement, shaped, motion)


def align_to_person(
    motion: Motion, shaped: ShapedBody, person: ShapedBody, evidence: CaptureEvidence
) -> BodyAlignment:
    """Align a motion, made for `shaped`, to an avatar's person, whose body stays."""
    foreign, same = needs_placement(motion, shaped), is_same_person(person, shaped)
    if same and not foreign:
        return BodyAlignment(shaped=person, motion=motion)
    objective = None
    if foreign or evidence.has_masks:
        there = evidence.geometry(motion)
        objective = evidence.silhouettes(SkinPoints.of(person), there, ALIGNMENT_SAMPLES)
    if not same and not (foreign and objective is not None):
        motion = rescale_motion(evidence.geometry(motion), shaped, person)
    difference = "" if foreign or same else _describe_difference(shaped, person)
    placement = None
    if objective is not None:
        placement = place_body_on_masks(evidence.geometry(motion), objective)
    return _accept(placement, person, motion, difference)


def is_same_person(a: ShapedBody, b: ShapedBody) -> bool:
    """Check whether two shapes of one body model are the same person."""
    same = a.vertices.shape == b.vertices.shape
    return same and all(
        bool(np.abs(one - other).max() < SAME_SHAPE_M)
        for one, other in ((a.vertices, b.vertices), (a.joints, b.joints))
    )


def _accept(
    placement: BodyPlacement | None, shaped: ShapedBody, motion: Motion, prefix: str = ""
) -> BodyAlignment:
    """The alignment with a placement, if there is one, which is taken if it is an improvement."""
    if placement is None:
        return BodyAlignment(shaped=shaped, motion=motion, description=prefix)
    return BodyAlignment(
        shaped=shaped,
        motion=placement.motion if placement.is_improvement else motion,
        description=f"{prefix} {placement.describe()}".strip(),
        placement=placement,
    )


def _describe_difference(shaped: ShapedBody, person: ShapedBody) -> str:
    """Describe how the poses' body differs from the avatar's; empty if they are alike."""
    theirs, ours = body_height_m(shaped), body_height_m(person)
    off = (shaped.joints - shaped.joints[0]) - (person.joints - person.joints[0])
    apart = float(np.linalg.norm(off, axis=1).max())
    if abs(theirs - ours) < REPORTED_DIFFERENCE_M and apart < REPORTED_DIFFERENCE_M:
        return ""
    doubt = " Is it the same person?" if abs(theirs / ours - 1.0) > MAX_HEIGHT_DIFFERENCE else ""
    return (
        f"Their betas state a body of {100.0 * theirs:.0f} cm, the avatar's has "
        f"{100.0 * ours:.0f} cm (joints up to {100.0 * apart:.1f} cm elsewhere): the avatar keeps "
        f"its own, and these poses follow.{doubt}"
    )


def _with_body(objective: SilhouetteObjective, shaped: ShapedBody) -> SilhouetteObjective:
    """The objective of the same masks for another person."""
    return SilhouetteObjective(samples=objective.samples, skin=SkinPoints.of(shaped))


MIN_SMPL_IOU_GAIN = 0.05
"""Gain in mean IoU by which SMPL's body must beat the file's."""


def place_motion(
    motion_read: Motion, body: BodyModel, evidence: CaptureEvidence, *, cameras_given: bool
) -> tuple[Motion, ShapedBody]:
    """Place a motion in the cameras' world, and shape the person that it was made for.

    InstantAvatar and its successors write SMPL's poses without naming the body model; this project
    names it. Betas of one body model are meaningless for another. So a motion whose file does not
    state the body model is labeled as SMPL's if SMPL's body fits better.

    `cameras_given` tells that a file states the cameras (`place_in_camera_world`).
    """

    def placed(motion: Motion) -> tuple[Motion, ShapedBody]:
        shaped = shape_for_motion(body, motion)
        there = place_in_camera_world(motion, shaped, evidence.cameras, cameras_given=cameras_given)
        return there, shaped

    own = placed(motion_read)
    if motion_read.model_is_stated or body.family == "smpl":
        return own
    smpl = placed(replace(motion_read, body_model="smpl"))
    one, other = ((evidence.geometry(each), who) for each, who in (own, smpl))
    reason = _smpl_fits_masks(one, other, evidence)
    if reason is None:
        return own
    words = (
        "The poses' file does not state the body model they were made for (`model`); they are "
        f"taken for SMPL's, {reason}."
    )
    note = words if motion_read.note is None else f"{motion_read.note} {words}"
    return replace(smpl[0], note=note), smpl[1]


PosedPerson = tuple[CaptureGeometry, ShapedBody]
"""A motion in its geometry, and the person it is for."""


def _smpl_fits_masks(own: PosedPerson, smpl: PosedPerson, evidence: CaptureEvidence) -> str | None:
    """Words on how much better SMPL's body fits the masks than the file's; None if it does not."""
    objective = evidence.silhouettes(SkinPoints.of(own[1]), own[0], ALIGNMENT_SAMPLES)
    if objective is None or mean_score(objective.frame_scores(own[0])) >= GOOD_IOU:
        return None
    before = place_body_on_masks(own[0], objective).iou_after
    after = place_body_on_masks(smpl[0], _with_body(objective, smpl[1])).iou_after
    if after < before + MIN_SMPL_IOU_GAIN:
        return None
    return f"whose mean IoU with the masks is {after:.2f}, not {before:.2f}"


def fit_person(
    motion: Motion,
    shaped: ShapedBody,
    evidence: CaptureEvidence,
    *,
    avatar_body: Path | None,
    height_m: float | None,
) -> BodyAlignment:
    """Fit body and poses to the masks, to a finished avatar's person, or to a stated height.

    Args:
        motion: In the cameras' world, for the body `shaped`.
        avatar_body: File of the avatar's person, if these poses are added to one.
        height_m: Stated height of the person, metres.

    Raises:
        InputError: If a stated height cannot be had.
    """
    if avatar_body is not None:
        person = read_shaped_body(avatar_body, shaped.body)
        _check_height(person, height_m)
        return align_to_person(motion, shaped, person, evidence)
    fit = align_body(motion, shaped, evidence)
    if height_m is None:
        return fit
    cameras = evidence.cameras
    if cameras.is_moving:
        raise InputError(
            f"--height-cm contradicts {cameras.source}, whose cameras move through a world of a "
            "size of its own. Leave one of them out."
        )
    taller = scale_to_height(fit.shaped, height_m)
    moved = rescale_motion(evidence.geometry(fit.motion), fit.shaped, taller)
    return replace(fit, shaped=taller, motion=moved)


def _check_height(person: ShapedBody, height_m: float | None) -> None:
    """Raises if a stated height is not the avatar's."""
    height_cm = 100.0 * body_height_m(person)
    if height_m is not None and abs(100.0 * height_m - height_cm) > HEIGHT_TOLERANCE_CM:
        raise InputError(
            f"--height-cm is {100.0 * height_m:.0f}, but the avatar in --out is {height_cm:.0f} cm "
            "tall, which was settled by its first video. Leave it out, or train it from the start "
            "(--overwrite)."
        )

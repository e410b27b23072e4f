"""Poses brought to the body that is really used: another than their tracker's, or the avatar's own.

Without SMPL's file, SMPL's poses move the embedded body; and poses that are added to a finished
avatar move the person that it has, whatever their betas say. Rotations stay as they are; distance
and place are solved anew from masks, or, where there are none, from the pictures themselves.
"""

from dataclasses import dataclass

import numpy as np

from capture.errors import InputError
from capture.source import FrameSource
from preprocess.body import ShapedBody
from preprocess.camera_file import CameraTrack
from preprocess.doctor.claim import CaptureGeometry
from preprocess.doctor.evidence import SilhouetteObjective, sample_masks
from preprocess.fit.pictures import sample_video
from preprocess.fit.refit import ALIGNMENT_SAMPLES, BodyPlacement, place_body_on_masks
from preprocess.fit.stature import rescale_motion, body_height_m
from preprocess.fit.unmasked import place_body_on_images
from preprocess.masks.files import Masks
from preprocess.observe import associate_cameras, associate_masks
from preprocess.pose import Motion
from preprocess.silhouette import SkinPoints

MIN_OWN_SHAPE_GAIN = 0.02
"""By how much the body's own proportions must fit better than SMPL's to be taken instead."""
SAME_SHAPE_M = 5e-4
"""Bodies whose resting skin is nowhere farther apart are one."""
REPORTED_DIFFERENCE_M = 0.01
"""Differences in height, or of a joint from the pelvis, that are spoken of."""
MAX_HEIGHT_DIFFERENCE = 0.08
"""Difference in height, as a share, beyond which it may not be the same person."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyAlignment:
    """A person and poses that belong together.

    Attributes:
        shaped: The person's body.
        motion: The poses, for this body.
        words: What was done, for people; empty if nothing was.
        refit: What was found in the masks, if something was looked for.
    """

    shaped: ShapedBody
    motion: Motion
    description: str = ""
    placement: BodyPlacement | None = None


def needs_placement(motion: Motion, shaped: ShapedBody) -> bool:
    """Whether poses were made for a body model whose size nobody knows here."""
    return shaped.body.family not in ("smpl", motion.body_model)


def align_body(
    motion: Motion,
    shaped: ShapedBody,
    cameras: CameraTrack,
    source: FrameSource,
    masks: Masks | None,
) -> BodyAlignment:
    """Body and motion as they fit the masks, if the tracker had another body in mind.

    The body's own mean proportions are tried beside SMPL's; they are taken if they fit better by
    `MIN_OWN_SHAPE_GAIN`: files say SMPL of poses that were fitted to something else.

    Args:
        motion: In the cameras' world.
        shaped: The body that is used, with SMPL's mean joints (`shape_for_motion`).
        cameras: Of the frames' size.
        source: The frames; few are decoded, and none if there are masks in files.
        masks: The masks; None if the pictures have an alpha channel, or nobody knows any.
    """
    if not needs_placement(motion, shaped):
        return BodyAlignment(shaped=shaped, motion=motion)
    claim = CaptureGeometry.of(motion, cameras, source)
    if masks is None and not source.has_alpha:
        seen = place_from_video(claim, shaped, cameras, source)
        fit = BodyAlignment(shaped=shaped, motion=motion)
        return fit if seen is None else _accept(seen, shaped, motion)
    evidence = silhouette_objective_of(shaped, cameras, source, masks)
    if evidence is None:
        return BodyAlignment(shaped=shaped, motion=motion)
    refit = place_body_on_masks(claim, evidence)
    own = shaped.body.with_shape()
    other = place_body_on_masks(claim, _with_body(evidence, own))
    if other.is_improvement and other.iou_after > refit.iou_after + MIN_OWN_SHAPE_GAIN:
        words = f"{other.describe()} Its own proportions fit better than SMPL's."
        return BodyAlignment(shaped=own, motion=other.motion, description=words, placement=other)
    return _accept(refit, shaped, motion)


def align_to_person(
    motion: Motion,
    shaped: ShapedBody,
    person: ShapedBody,
    cameras: CameraTrack,
    source: FrameSource,
    masks: Masks | None,
) -> BodyAlignment:
    """The motion for the person that an avatar has, which never changes.

    Args:
        motion: In the cameras' world, for the body `shaped`.
        shaped: The person that these poses' tracker had in mind.
        person: The avatar's.
        cameras, source, masks: As in `align_body`.
    """
    foreign, same = needs_placement(motion, shaped), is_same_person(person, shaped)
    if same and not foreign:
        return BodyAlignment(shaped=person, motion=motion)
    masked = masks is not None or source.has_alpha
    evidence = silhouette_objective_of(person, cameras, source, masks) if masked else None
    claim = CaptureGeometry.of(motion, cameras, source)
    if not same and not (foreign and evidence is not None):
        motion = rescale_motion(claim, shaped, person)
        claim = CaptureGeometry.of(motion, cameras, source)
    told = "" if foreign or same else _describe_difference(shaped, person)
    refit = None
    if evidence is not None:
        refit = place_body_on_masks(claim, evidence)
    elif foreign and not masked:
        refit = place_from_video(claim, person, cameras, source)
    if refit is None:
        return BodyAlignment(shaped=person, motion=motion, description=told)
    return _accept(refit, person, motion, told)


def is_same_person(a: ShapedBody, b: ShapedBody) -> bool:
    """Whether two shapes of one body are the same person."""
    same = a.vertices.shape == b.vertices.shape
    return same and all(
        bool(np.abs(one - other).max() < SAME_SHAPE_M)
        for one, other in ((a.vertices, b.vertices), (a.joints, b.joints))
    )


def _accept(placement: BodyPlacement, shaped: ShapedBody, motion: Motion, prefix: str = "") -> BodyAlignment:
    """The refit, if it is worth it."""
    return BodyAlignment(
        shaped=shaped,
        motion=placement.motion if placement.is_improvement else motion,
        description=f"{prefix} {placement.describe()}".strip(),
        placement=placement,
    )


def _describe_difference(shaped: ShapedBody, person: ShapedBody) -> str:
    """How the body that poses were made for differs from the avatar's; empty if it hardly does."""
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


def place_from_video(
    geometry: CaptureGeometry, shaped: ShapedBody, cameras: CameraTrack, source: FrameSource
) -> BodyPlacement | None:
    """The body fitted to a few pictures; None where parts do not fit, which is said elsewhere."""
    skin = SkinPoints.of(shaped)
    try:
        pictures = sample_video(geometry, skin, cameras, source)
    except InputError:
        return None
    return place_body_on_images(geometry, skin, pictures)


def silhouette_objective_of(
    shaped: ShapedBody, cameras: CameraTrack, source: FrameSource, masks: Masks | None
) -> SilhouetteObjective | None:
    """A few masks; None where parts do not fit or show nobody, which is said elsewhere."""
    try:
        rows = associate_masks(masks, source), associate_cameras(cameras, source)
        return sample_masks(
            source, masks, *rows, SkinPoints.of(shaped), count=ALIGNMENT_SAMPLES, excluded_frames=cameras.frames_without_camera
        )
    except InputError:
        return None


def _with_body(evidence: SilhouetteObjective, shaped: ShapedBody) -> SilhouetteObjective:
    """The same masks, for another person."""
    return SilhouetteObjective(samples=evidence.samples, skin=SkinPoints.of(shaped))

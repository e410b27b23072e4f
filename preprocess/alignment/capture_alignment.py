"""A focal length that nobody knows, found from masks and poses.

Poses brought to the body that is really used: another than their tracker's, or the avatar's own.

Without SMPL's file, SMPL's poses move the embedded body; and poses that are added to a finished
avatar move the person that it has, whatever their betas say. Rotations stay as they are; distance
and place are solved anew from masks, or, where there are none, from the pictures themselves.

Whose body poses were made for, where their file does not say: masks or pictures are asked.
"""

from dataclasses import dataclass, replace

import numpy as np

from capture.input_error import InputError
from capture.source import FrameSource
from preprocess.alignment.camera_from_masks import fit_factor
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.correction_search import (
    GOOD_IOU,
    MIN_FITTED_CHANGE,
    MIN_FITTED_IOU_GAIN,
)
from preprocess.alignment.corrections import scale_focal_length
from preprocess.alignment.image_alignment import edge_contrast, place_body_on_images, sample_video
from preprocess.alignment.mask_alignment import (
    ALIGNMENT_SAMPLES,
    MIN_EDGE_CONTRAST,
    BodyPlacement,
    body_height_m,
    place_body_on_masks,
    rescale_motion,
)
from preprocess.alignment.silhouette_objective import (
    SilhouetteObjective,
    mean_score,
    sample_masks,
)
from preprocess.body.body_pose import Motion
from preprocess.body.parametric_body import BodyModel, ShapedBody, shape_for_motion
from preprocess.body.silhouette import SkinPoints
from preprocess.cameras.camera_file import CameraTrack
from preprocess.masks.mask_files import Masks
from preprocess.observe import associate_cameras, associate_masks
from preprocess.poses.root_placement import place_in_camera_world

FOCAL_SAMPLES = 6
MIN_FOCAL_IOU = 0.6
"""A focal length is believed if body and masks then agree by so much."""


def estimate_focal_length(
    cameras: CameraTrack,
    motion: Motion,
    shaped: ShapedBody,
    source: FrameSource,
    masks: Masks | None,
) -> CameraTrack:
    """The assumed camera with the focal length by which the body covers the masks.

    It is changed only if that fits clearly better. Of poses that another body was in mind for, size
    and focal length cannot be told apart; then nothing is done.

    Args:
        cameras: One camera, whose focal length was assumed (`assume_static_camera`).
        motion: In the camera's world.
        shaped: The person.
        source: The frames; none is decoded.
        masks: The masks; None if there are none in files, and then nothing is done.
    """
    if masks is None or motion.body_model != shaped.body.family:
        return cameras
    claim = CaptureGeometry.of(motion, cameras, source)
    try:
        row = associate_masks(masks, source)
        skin = SkinPoints.of(shaped)
        evidence = sample_masks(source, masks, row, lambda frame: 0, skin, count=FOCAL_SAMPLES)
    except InputError:  # parts that do not fit: that is said elsewhere
        return cameras
    factor = fit_factor(scale_focal_length, claim, evidence).factor or 1.0
    before = mean_score(evidence.frame_scores(claim))
    after = mean_score(evidence.frame_scores(scale_focal_length(factor).apply(claim)))
    if (
        after < max(MIN_FOCAL_IOU, before + MIN_FITTED_IOU_GAIN)
        or abs(factor - 1.0) < MIN_FITTED_CHANGE
    ):
        return cameras
    old = cameras[0]
    focal = old.focal_px[0] * factor, old.focal_px[1] * factor
    return replace(
        cameras,
        cameras=(replace(old, focal_px=focal),),
        source="focal length found from the masks",
        note=f"No camera was given; a focal length of {focal[0]:.0f} px was found from the masks: "
        f"with it they agree with the body by {after:.2f}, with the usual {old.focal_px[0]:.0f} px "
        f"by {before:.2f}.",
    )


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


def _accept(
    placement: BodyPlacement, shaped: ShapedBody, motion: Motion, prefix: str = ""
) -> BodyAlignment:
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
            source,
            masks,
            *rows,
            SkinPoints.of(shaped),
            count=ALIGNMENT_SAMPLES,
            excluded_frames=cameras.frames_without_camera,
        )
    except InputError:
        return None


def _with_body(evidence: SilhouetteObjective, shaped: ShapedBody) -> SilhouetteObjective:
    """The same masks, for another person."""
    return SilhouetteObjective(samples=evidence.samples, skin=SkinPoints.of(shaped))


MIN_SMPL_IOU_GAIN = 0.05
"""By how much SMPL's body must agree better with the masks to be taken."""
MIN_SMPL_CONTRAST_RATIO = 1.1
"""Without masks: how many times more it must stand out from what is beside it in the pictures."""


def detect_body_model(
    motion_read: Motion,
    body: BodyModel,
    cameras: CameraTrack,
    source: FrameSource,
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
        cameras, source, masks: See `align_body`.
        cameras_given: See `placed`.
    """
    if motion_read.model_is_stated or body.family == "smpl":
        return motion_read
    if masks is None and not source.has_alpha:
        return _detect_from_images(motion_read, body, cameras, source, cameras_given=cameras_given)
    after = {}
    for model in (motion_read.body_model, "smpl"):
        motion = replace(motion_read, body_model=model)
        shaped = shape_for_motion(body, motion)
        motion = place_in_camera_world(motion, shaped, cameras, cameras_given=cameras_given)
        evidence = silhouette_objective_of(shaped, cameras, source, masks)
        if evidence is None:
            return motion_read
        claim = CaptureGeometry.of(motion, cameras, source)
        if model == motion_read.body_model and mean_score(evidence.frame_scores(claim)) >= GOOD_IOU:
            return motion_read
        after[model] = place_body_on_masks(claim, evidence).iou_after
    if after["smpl"] < after[motion_read.body_model] + MIN_SMPL_IOU_GAIN:
        return motion_read
    found = (
        f"with which masks agree by {after['smpl']:.2f} (else {after[motion_read.body_model]:.2f})"
    )
    return _label_smpl(motion_read, found)


def _detect_from_images(
    motion_read: Motion,
    body: BodyModel,
    cameras: CameraTrack,
    source: FrameSource,
    *,
    cameras_given: bool,
) -> Motion:
    """The same where there are no masks: by how the pictures' edges run along the body."""
    stands_out = {}
    for model in (motion_read.body_model, "smpl"):
        motion = replace(motion_read, body_model=model)
        shaped = shape_for_motion(body, motion)
        motion = place_in_camera_world(motion, shaped, cameras, cameras_given=cameras_given)
        claim, skin = CaptureGeometry.of(motion, cameras, source), SkinPoints.of(shaped)
        try:
            pictures = sample_video(claim, skin, cameras, source)
        except InputError:
            return motion_read
        if model == motion_read.body_model:
            stands_out[model] = edge_contrast(claim, skin, pictures)
        else:
            fitted = place_body_on_images(claim, skin, pictures)
            stands_out[model] = edge_contrast(replace(claim, motion=fitted.motion), skin, pictures)
    if stands_out["smpl"] < MIN_SMPL_CONTRAST_RATIO * max(
        stands_out[motion_read.body_model], MIN_EDGE_CONTRAST
    ):
        return motion_read
    found = (
        f"whose outline stands out {stands_out['smpl']:.1f} times from what is beside it in the "
        f"pictures (else {stands_out[motion_read.body_model]:.1f} times)"
    )
    return _label_smpl(motion_read, found)


def _label_smpl(motion_read: Motion, reason: str) -> Motion:
    said = (
        "The poses' file does not say for which body they were made (`model`); they are taken for "
        f"SMPL's, {reason}."
    )
    note = said if motion_read.note is None else f"{motion_read.note} {said}"
    return replace(motion_read, body_model="smpl", note=note)

"""Alignment of a capture: the poses' body model, their placement, and an unknown focal length.

Poses may be for another body than the one that is used: without SMPL's file SMPL's poses move the
embedded body, and poses that are added to a finished avatar move its own person, whatever their
betas state. Rotations stay; distance and pelvis shift are fitted to masks or, without masks, to
images. Where a file does not state the body model of its poses, the better fit decides.
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
from preprocess.body.parametric_body import BodyModel, ShapedBody
from preprocess.body.proportion_space import shape_for_motion
from preprocess.body.silhouette import SkinPoints
from preprocess.cameras.camera_file import CameraTrack
from preprocess.masks.mask_files import Masks
from preprocess.observe import associate_cameras, associate_masks
from preprocess.poses.root_placement import place_in_camera_world

FOCAL_SAMPLES = 6
"""Frames to whose masks a focal length is fitted."""
MIN_FOCAL_IOU = 0.6
"""Mean IoU of body and masks from which a fitted focal length is taken."""


def estimate_focal_length(
    cameras: CameraTrack,
    motion: Motion,
    shaped: ShapedBody,
    source: FrameSource,
    masks: Masks | None,
) -> CameraTrack:
    """Fit the focal length of an assumed camera so that the body covers the masks.

    It changes only if that fits clearly better, and not for poses of another body model: their size
    and the focal length are ambiguous.

    Args:
        cameras: One camera, whose focal length was assumed (`assume_static_camera`).
        motion: Poses in the camera's world.
        shaped: The person.
        source: The frames; none is decoded.
        masks: The masks; None if there are no mask files: then the camera stays.
    """
    if masks is None or motion.body_model != shaped.body.family:
        return cameras
    geometry = CaptureGeometry.of(motion, cameras, source)
    try:
        row = associate_masks(masks, source)
        skin = SkinPoints.of(shaped)
        objective = sample_masks(source, masks, row, lambda frame: 0, skin, count=FOCAL_SAMPLES)
    except InputError:  # parts that do not fit are reported elsewhere
        return cameras
    scale = fit_factor(scale_focal_length, geometry, objective)
    factor = scale.factor or 1.0
    before = mean_score(objective.frame_scores(geometry))
    after = mean_score(objective.frame_scores(scale.apply(geometry)))
    is_better = after >= max(MIN_FOCAL_IOU, before + MIN_FITTED_IOU_GAIN)
    if not is_better or abs(factor - 1.0) < MIN_FITTED_CHANGE:
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
"""Gain in mean IoU by which the body's own proportions must beat SMPL's."""
SAME_SHAPE_M = 5e-4
"""Largest distance between the resting surfaces of bodies that are the same, metres."""
REPORTED_DIFFERENCE_M = 0.01
"""Least difference in height, or of a joint relative to the pelvis, that is reported, metres."""
MAX_HEIGHT_DIFFERENCE = 0.08
"""Relative difference in height beyond which it may not be the same person."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyAlignment:
    """A person and poses that belong together.

    Attributes:
        shaped: The person's body.
        motion: The poses for this body.
        description: What was done, for people; empty if nothing was.
        placement: The fitted placement; None if none was attempted.
    """

    shaped: ShapedBody
    motion: Motion
    description: str = ""
    placement: BodyPlacement | None = None


def needs_placement(motion: Motion, shaped: ShapedBody) -> bool:
    """Whether poses were made for a body model whose size is unknown here."""
    return shaped.body.family not in ("smpl", motion.body_model)


def align_body(
    motion: Motion,
    shaped: ShapedBody,
    cameras: CameraTrack,
    source: FrameSource,
    masks: Masks | None,
) -> BodyAlignment:
    """Align body and motion to the masks, if the poses are of another body model.

    The body's own mean proportions are tried beside SMPL's and taken if they fit better by
    `MIN_OWN_SHAPE_GAIN`: files state SMPL for poses that were fitted to another body.

    Args:
        motion: Poses in the cameras' world.
        shaped: The body that is used, with SMPL's mean joints (`shape_for_motion`).
        cameras: Cameras of the frames' size.
        source: The frames; few are decoded, and none if there are mask files.
        masks: The masks; None if the images have an alpha channel, or there are none.
    """
    if not needs_placement(motion, shaped):
        return BodyAlignment(shaped=shaped, motion=motion)
    geometry = CaptureGeometry.of(motion, cameras, source)
    if masks is None and not source.has_alpha:
        return _accept(place_from_video(geometry, shaped, cameras, source), shaped, motion)
    objective = silhouette_objective_of(shaped, cameras, source, masks)
    if objective is None:
        return _accept(None, shaped, motion)
    placement = place_body_on_masks(geometry, objective)
    own = shaped.body.with_shape()
    other = place_body_on_masks(geometry, _with_body(objective, own))
    if other.is_improvement and other.iou_after > placement.iou_after + MIN_OWN_SHAPE_GAIN:
        words = f"{other.describe()} Its own proportions fit better than SMPL's."
        return BodyAlignment(shaped=own, motion=other.motion, description=words, placement=other)
    return _accept(placement, shaped, motion)


def align_to_person(
    motion: Motion,
    shaped: ShapedBody,
    person: ShapedBody,
    cameras: CameraTrack,
    source: FrameSource,
    masks: Masks | None,
) -> BodyAlignment:
    """Align a motion to an avatar's person, whose body stays.

    Args:
        motion: Poses in the cameras' world, for the body `shaped`.
        shaped: The person that the poses were made for.
        person: The avatar's person.
        cameras: Cameras of the frames' size.
        source: The frames; few are decoded, and none if there are mask files.
        masks: The masks; None if the images have an alpha channel, or there are none.
    """
    foreign, same = needs_placement(motion, shaped), is_same_person(person, shaped)
    if same and not foreign:
        return BodyAlignment(shaped=person, motion=motion)
    masked = masks is not None or source.has_alpha
    objective = silhouette_objective_of(person, cameras, source, masks) if masked else None
    geometry = CaptureGeometry.of(motion, cameras, source)
    if not same and not (foreign and objective is not None):
        motion = rescale_motion(geometry, shaped, person)
        geometry = CaptureGeometry.of(motion, cameras, source)
    difference = "" if foreign or same else _describe_difference(shaped, person)
    placement = None
    if objective is not None:
        placement = place_body_on_masks(geometry, objective)
    elif foreign and not masked:
        placement = place_from_video(geometry, person, cameras, source)
    return _accept(placement, person, motion, difference)


def is_same_person(a: ShapedBody, b: ShapedBody) -> bool:
    """Whether two shapes of one body model are the same person."""
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


def place_from_video(
    geometry: CaptureGeometry, shaped: ShapedBody, cameras: CameraTrack, source: FrameSource
) -> BodyPlacement | None:
    """Align a body to a few images; None where parts do not fit (reported elsewhere)."""
    skin = SkinPoints.of(shaped)
    try:
        images = sample_video(geometry, skin, cameras, source)
    except InputError:
        return None
    return place_body_on_images(geometry, skin, images)


def silhouette_objective_of(
    shaped: ShapedBody, cameras: CameraTrack, source: FrameSource, masks: Masks | None
) -> SilhouetteObjective | None:
    """The objective of a few masks; None where parts do not fit (reported elsewhere)."""
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


def _with_body(objective: SilhouetteObjective, shaped: ShapedBody) -> SilhouetteObjective:
    """The objective of the same masks for another person."""
    return SilhouetteObjective(samples=objective.samples, skin=SkinPoints.of(shaped))


MIN_SMPL_IOU_GAIN = 0.05
"""Gain in mean IoU by which SMPL's body must beat the file's."""
MIN_SMPL_CONTRAST_RATIO = 1.1
"""Ratio of edge contrasts by which SMPL's body must beat the file's, without masks."""


def detect_body_model(
    motion_read: Motion,
    body: BodyModel,
    cameras: CameraTrack,
    source: FrameSource,
    masks: Masks | None,
    *,
    cameras_given: bool,
) -> Motion:
    """Label a motion as SMPL's if its file does not state the body model and SMPL's fits better.

    InstantAvatar and its successors write SMPL's poses without naming the body model; this project
    names it. Betas of one body model are meaningless for another.

    Args:
        motion_read: The motion that `read_poses` returns.
        body: The body model that is used.
        cameras: Cameras of the frames' size.
        source: The frames; few are decoded, and none if there are mask files.
        masks: The masks; None if the images have an alpha channel, or there are none.
        cameras_given: Whether a file states the cameras; see `place_in_camera_world`.
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
        objective = silhouette_objective_of(shaped, cameras, source, masks)
        if objective is None:
            return motion_read
        geometry = CaptureGeometry.of(motion, cameras, source)
        if (
            model == motion_read.body_model
            and mean_score(objective.frame_scores(geometry)) >= GOOD_IOU
        ):
            return motion_read
        after[model] = place_body_on_masks(geometry, objective).iou_after
    if after["smpl"] < after[motion_read.body_model] + MIN_SMPL_IOU_GAIN:
        return motion_read
    other = after[motion_read.body_model]
    return _label_smpl(
        motion_read, f"whose mean IoU with the masks is {after['smpl']:.2f}, not {other:.2f}"
    )


def _detect_from_images(
    motion_read: Motion,
    body: BodyModel,
    cameras: CameraTrack,
    source: FrameSource,
    *,
    cameras_given: bool,
) -> Motion:
    """Detect the body model by the contrast of the images' edges along the body's outline."""
    contrast = {}
    for model in (motion_read.body_model, "smpl"):
        motion = replace(motion_read, body_model=model)
        shaped = shape_for_motion(body, motion)
        motion = place_in_camera_world(motion, shaped, cameras, cameras_given=cameras_given)
        geometry, skin = CaptureGeometry.of(motion, cameras, source), SkinPoints.of(shaped)
        try:
            images = sample_video(geometry, skin, cameras, source)
        except InputError:
            return motion_read
        if model == motion_read.body_model:
            contrast[model] = edge_contrast(geometry, skin, images)
        else:
            fitted = place_body_on_images(geometry, skin, images)
            contrast[model] = edge_contrast(replace(geometry, motion=fitted.motion), skin, images)
    if contrast["smpl"] < MIN_SMPL_CONTRAST_RATIO * max(
        contrast[motion_read.body_model], MIN_EDGE_CONTRAST
    ):
        return motion_read
    found = (
        f"across whose outline edges are {contrast['smpl']:.1f} times as strong as beside it, not "
        f"{contrast[motion_read.body_model]:.1f} times"
    )
    return _label_smpl(motion_read, found)


def _label_smpl(motion_read: Motion, reason: str) -> Motion:
    words = (
        "The poses' file does not state the body model they were made for (`model`); they are "
        f"taken for SMPL's, {reason}."
    )
    note = words if motion_read.note is None else f"{motion_read.note} {words}"
    return replace(motion_read, body_model="smpl", note=note)

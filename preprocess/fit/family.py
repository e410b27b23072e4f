"""Whose body poses were made for, where their file does not say: masks or pictures are asked."""

from dataclasses import replace

from capture.errors import InputError
from capture.source import FrameSource
from preprocess.body import BodyModel
from preprocess.camera_file import CameraTrack
from preprocess.doctor.claim import CaptureGeometry
from preprocess.doctor.diagnosis import GOOD_IOU, mean_score
from preprocess.fit.body_fit import silhouette_objective_of
from preprocess.fit.pictures import edge_contrast, sample_video
from preprocess.fit.refit import MIN_EDGE_CONTRAST, place_body_on_masks
from preprocess.fit.unmasked import place_body_on_images
from preprocess.masks.files import Masks
from preprocess.pose import Motion
from preprocess.poses.place import place_in_camera_world
from preprocess.shape import shape_for_motion
from preprocess.silhouette import SkinPoints

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
    found = f"with which masks agree by {after['smpl']:.2f} (else {after[motion_read.body_model]:.2f})"
    return _label_smpl(motion_read, found)


def _detect_from_images(
    motion_read: Motion, body: BodyModel, cameras: CameraTrack, source: FrameSource, *, cameras_given: bool
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
    if stands_out["smpl"] < MIN_SMPL_CONTRAST_RATIO * max(stands_out[motion_read.body_model], MIN_EDGE_CONTRAST):
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

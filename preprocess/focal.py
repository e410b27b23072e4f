"""A focal length that nobody knows, found from masks and poses."""

from dataclasses import replace

from capture.errors import InputError
from capture.source import FrameSource
from preprocess.body import ShapedBody
from preprocess.camera_file import CameraTrack
from preprocess.doctor.claim import CaptureGeometry
from preprocess.doctor.cure import scale_focal_length
from preprocess.doctor.diagnosis import MIN_FITTED_CHANGE, MIN_FITTED_IOU_GAIN, fit_factor, mean_score
from preprocess.doctor.evidence import sample_masks
from preprocess.masks.files import Masks
from preprocess.observe import associate_masks
from preprocess.pose import Motion
from preprocess.silhouette import SkinPoints

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
    if after < max(MIN_FOCAL_IOU, before + MIN_FITTED_IOU_GAIN) or abs(factor - 1.0) < MIN_FITTED_CHANGE:
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

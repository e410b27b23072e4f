"""A focal length that nobody knows, found from masks and poses."""

from dataclasses import replace

from capture.errors import BadInput
from capture.source import Source
from preprocess.body import ShapedBody
from preprocess.camera_file import CameraTrack
from preprocess.doctor.claim import Claim
from preprocess.doctor.cure import refocused
from preprocess.doctor.diagnosis import FITTED_CHANGE, FITTED_GAIN, fit_factor, mean
from preprocess.doctor.evidence import gather
from preprocess.masks.files import Masks
from preprocess.observe import check_masks
from preprocess.pose import Motion
from preprocess.silhouette import SkinPoints

FRAMES = 6
LEAST = 0.6
"""A focal length is believed if body and masks then agree by so much."""


def focal_from_masks(
    cameras: CameraTrack,
    motion: Motion,
    shaped: ShapedBody,
    source: Source,
    masks: Masks | None,
) -> CameraTrack:
    """The assumed camera with the focal length by which the body covers the masks.

    It is changed only if that fits clearly better. Of poses that another body was in mind for, size
    and focal length cannot be told apart; then nothing is done.

    Args:
        cameras: One camera, whose focal length was assumed (`default_cameras`).
        motion: In the camera's world.
        shaped: The person.
        source: The frames; none is decoded.
        masks: The masks; None if there are none in files, and then nothing is done.
    """
    if masks is None or motion.model != shaped.body.family:
        return cameras
    claim = Claim.of(motion, cameras, source)
    try:
        row = check_masks(masks, source)
        skin = SkinPoints.of(shaped)
        evidence = gather(source, masks, row, lambda frame: 0, skin, count=FRAMES)
    except BadInput:  # parts that do not fit: that is said elsewhere
        return cameras
    factor = fit_factor(refocused, claim, evidence).factor or 1.0
    before = mean(evidence.scores(claim))
    after = mean(evidence.scores(refocused(factor).undo(claim)))
    if after < max(LEAST, before + FITTED_GAIN) or abs(factor - 1.0) < FITTED_CHANGE:
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

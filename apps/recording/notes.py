"""What a user should know about how the parts of a recording were read."""

import shlex
from collections.abc import Iterator
from pathlib import Path

from preprocess.camera_file import CameraTrack
from preprocess.fit.body_fit import BodyAlignment
from preprocess.masks.choice import MaskOrigin
from preprocess.masks.files import Masks


def describe_capture(
    fit: BodyAlignment,
    masks: Masks | None,
    cameras: CameraTrack,
    choice: MaskOrigin,
    *,
    unread_alpha_video: Path | None = None,
    expected_masks: Path | None = None,
) -> Iterator[str]:
    """Sentences, one after the other.

    Args:
        fit: Poses and body.
        masks: The masks, if a file holds them.
        cameras: The cameras.
        choice: Which masks are used.
        unread: The video, if it has an alpha channel that is not read.
        looked_for: Where a segmenter was expected to write the masks of a live source.
    """
    motion, family = fit.motion, fit.shaped.body.family
    if motion.note is not None:
        yield motion.note
    if cameras.note is not None:
        yield cameras.note
    if choice.segmenter is not None:
        yield (
            f"Masks are estimated from the pictures and the poses (segmenter:{choice.segmenter}); "
            "a segmenter's own masks (--masks) are sharper around hair and hands."
        )
    if choice.is_fallback and expected_masks is not None:
        yield f"There was no folder of masks {expected_masks} when the first pose came."
    if choice.is_fallback and unread_alpha_video is not None:
        folder = unread_alpha_video.with_name(f"{unread_alpha_video.stem}_frames")
        video, made, pictures = (
            shlex.quote(str(path)) for path in (unread_alpha_video, folder, folder / "%06d.png")
        )
        yield (
            f"{unread_alpha_video.name} has an alpha channel, which is not read from videos. If it cuts the "
            "person out, write pictures, and learn from their folder: "
            f"mkdir {made} && ffmpeg -i {video} {pictures}"
        )
    if choice.uses_alpha_channel:
        yield "The pictures' own alpha channel is used as their masks."
    if masks is not None and masks.inverted:
        yield f"The masks in {masks.path} show the background (white); they were inverted."
    if motion.body_model != family:
        yield (
            f"The poses were made for the body model {motion.body_model!r}, but {family!r} is used "
            f"(--body), with joints where the mean shape has them. {fit.description}".strip()
        )
    elif fit.description:
        yield fit.description
    lost = len(motion) - int(motion.valid.sum())
    if lost:
        yield (
            f"{lost} of {len(motion)} poses are NaN or marked as not valid; their frames are left "
            "out."
        )

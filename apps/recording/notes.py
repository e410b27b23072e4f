"""What a user should know about how the parts of a recording were read."""

import shlex
from collections.abc import Iterator
from pathlib import Path

from preprocess.camera_file import CameraTrack
from preprocess.fit.body_fit import BodyFit
from preprocess.masks.choice import MaskChoice
from preprocess.masks.files import Masks


def notes_of(
    fit: BodyFit,
    masks: Masks | None,
    cameras: CameraTrack,
    choice: MaskChoice,
    *,
    unread: Path | None = None,
    looked_for: Path | None = None,
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
    if choice.fallback and looked_for is not None:
        yield f"There was no folder of masks {looked_for} when the first pose came."
    if choice.fallback and unread is not None:
        folder = unread.with_name(f"{unread.stem}_frames")
        video, made, pictures = (
            shlex.quote(str(path)) for path in (unread, folder, folder / "%06d.png")
        )
        yield (
            f"{unread.name} has an alpha channel, which is not read from videos. If it cuts the "
            "person out, write pictures, and learn from their folder: "
            f"mkdir {made} && ffmpeg -i {video} {pictures}"
        )
    if choice.alpha:
        yield "The pictures' own alpha channel is used as their masks."
    if masks is not None and masks.inverted:
        yield f"The masks in {masks.path} show the background (white); they were inverted."
    if motion.model != family:
        yield (
            f"The poses were made for the body model {motion.model!r}, but {family!r} is used "
            f"(--body), with joints where the mean shape has them. {fit.words}".strip()
        )
    elif fit.words:
        yield fit.words
    lost = len(motion) - int(motion.valid.sum())
    if lost:
        yield (
            f"{lost} of {len(motion)} poses are NaN or marked as not valid; their frames are left "
            "out."
        )

"""What a user should know about how the parts of a recording were read."""

from collections.abc import Iterator

from preprocess.camera_file import CameraTrack
from preprocess.fit.body_fit import BodyFit
from preprocess.masks.files import Masks


def notes_of(
    fit: BodyFit, masks: Masks | None, cameras: CameraTrack, *, segment: str | None = None
) -> Iterator[str]:
    """Sentences, one after the other.

    Args:
        fit: Poses and body.
        masks: The masks, if a file holds them.
        cameras: The cameras.
        segment: What estimates the masks, if something does.
    """
    motion, family = fit.motion, fit.shaped.body.family
    if motion.note is not None:
        yield motion.note
    if cameras.note is not None:
        yield cameras.note
    if segment is not None:
        yield (
            f"Masks are estimated from the pictures and the poses (segmenter:{segment}); a "
            "segmenter's own masks (--masks) are sharper around hair and hands."
        )
    if masks is not None and masks.inverted:
        yield f"The masks in {masks.path} show the background; they were turned."
    if motion.model != family:
        yield (
            f"The poses were made for the body model {motion.model!r}, but {family!r} is used "
            f"(--body), with joints where the mean shape has them. {fit.words}".strip()
        )
    elif fit.words:
        yield fit.words
    lost = len(motion) - int(motion.valid.sum())
    if lost:
        yield f"{lost} of {len(motion)} poses are not valid; their frames are left out."

"""Whose body a recording's poses move: its own, one of a stated height, or a finished avatar's."""

from dataclasses import replace
from pathlib import Path

from capture.errors import InputError
from capture.source import FrameSource
from preprocess.body import ShapedBody
from preprocess.camera_file import CameraTrack
from preprocess.doctor.claim import CaptureGeometry
from preprocess.fit.body_fit import (
    BodyAlignment,
    is_same_person,
    align_body,
    align_to_person,
    needs_placement,
)
from preprocess.fit.growing import LiveAlignment
from preprocess.fit.stature import scale_to_height, rescale_motion, body_height_m
from preprocess.masks.files import Masks
from preprocess.person_file import read_shaped_body
from preprocess.pose import Motion

HEIGHT_TOLERANCE_CM = 1.5
"""A stated height that is so near to the avatar's own says the same."""
LIVE_FIT_NOTE = "Distance and place are fitted to the {} as they come."


def fit_person(
    motion: Motion,
    shaped: ShapedBody,
    cameras: CameraTrack,
    source: FrameSource,
    masks: Masks | None,
    *,
    avatar_body: Path | None,
    height_m: float | None,
) -> BodyAlignment:
    """The body, and the poses for it.

    Args:
        motion: In the cameras' world, for the body `shaped`.
        shaped: As the poses' tracker had it in mind.
        cameras, source, masks: See `align_body`.
        avatars: The person of a finished avatar, as a file, if these poses are added to one.
        height_m: How tall the person is, if somebody knows.

    Raises:
        InputError: If a stated height cannot be had.
    """
    if avatar_body is not None:
        person = read_shaped_body(avatar_body, shaped.body)
        _check_height(person, height_m)
        return align_to_person(motion, shaped, person, cameras, source, masks)
    fit = align_body(motion, shaped, cameras, source, masks)
    if height_m is None:
        return fit
    if cameras.is_moving:
        raise InputError(
            f"--height-cm contradicts {cameras.source}, whose cameras move through a world of a "
            "size of its own. Leave one of them out."
        )
    taller = scale_to_height(fit.shaped, height_m)
    moved = rescale_motion(CaptureGeometry.of(fit.motion, cameras, source), fit.shaped, taller)
    return replace(fit, shaped=taller, motion=moved)


def fit_live_person(
    motion: Motion, shaped: ShapedBody, *, avatar_body: Path | None, has_masks: bool
) -> tuple[BodyAlignment, LiveAlignment | None]:
    """The same of a live source, whose masks are yet to come.

    Args:
        motion: What has come of the poses.
        shaped: As their tracker had it in mind.
        avatars: See `person_of`.
        masked: Whether there will be masks that are not estimated.

    Returns:
        The body, and what fits the poses to it while they come, if that is needed.
    """
    person = shaped if avatar_body is None else read_shaped_body(avatar_body, shaped.body)
    foreign = needs_placement(motion, shaped)
    if not foreign and is_same_person(person, shaped):
        return BodyAlignment(shaped=person, motion=motion), None
    words = LIVE_FIT_NOTE.format("masks" if has_masks else "pictures")
    fit = BodyAlignment(shaped=person, motion=motion, description=words)
    return fit, LiveAlignment(person, motion.body_model, masked=has_masks)


def _check_height(person: ShapedBody, height_m: float | None) -> None:
    """Raises if a stated height is not the avatar's."""
    height_cm = 100.0 * body_height_m(person)
    if height_m is not None and abs(100.0 * height_m - height_cm) > HEIGHT_TOLERANCE_CM:
        raise InputError(
            f"--height-cm is {100.0 * height_m:.0f}, but the avatar in --out is {height_cm:.0f} cm "
            "tall, which was settled by its first video. Leave it out, or learn the avatar anew "
            "(--overwrite)."
        )

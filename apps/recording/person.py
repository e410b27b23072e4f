"""Whose body a recording's poses move: its own, one of a stated height, or a finished avatar's."""

from dataclasses import replace
from pathlib import Path

from capture.errors import BadInput
from capture.source import Source
from preprocess.body import ShapedBody
from preprocess.camera_file import CameraTrack
from preprocess.doctor.claim import Claim
from preprocess.fit.body_fit import (
    BodyFit,
    are_alike,
    fit_body,
    fit_to_person,
    is_foreign,
)
from preprocess.fit.growing import GrowingFit
from preprocess.fit.stature import as_tall, farther, height_of
from preprocess.masks.files import Masks
from preprocess.person_file import read_person
from preprocess.pose import Motion

SAME_CM = 1.5
"""A stated height that is so near to the avatar's own says the same."""
FITTED_LIVE = "Distance and place are fitted to the {} as they come."


def person_of(
    motion: Motion,
    shaped: ShapedBody,
    cameras: CameraTrack,
    source: Source,
    masks: Masks | None,
    *,
    avatars: Path | None,
    height_m: float | None,
) -> BodyFit:
    """The body, and the poses for it.

    Args:
        motion: In the cameras' world, for the body `shaped`.
        shaped: As the poses' tracker had it in mind.
        cameras, source, masks: See `fit_body`.
        avatars: The person of a finished avatar, as a file, if these poses are added to one.
        height_m: How tall the person is, if somebody knows.

    Raises:
        BadInput: If a stated height cannot be had.
    """
    if avatars is not None:
        person = read_person(avatars, shaped.body)
        _check_height(person, height_m)
        return fit_to_person(motion, shaped, person, cameras, source, masks)
    fit = fit_body(motion, shaped, cameras, source, masks)
    if height_m is None:
        return fit
    if cameras.moves:
        raise BadInput(
            f"--height-cm contradicts {cameras.source}, whose cameras move through a world of a "
            "size of its own. Leave one of them out."
        )
    taller = as_tall(fit.shaped, height_m)
    moved = farther(Claim.of(fit.motion, cameras, source), fit.shaped, taller)
    return replace(fit, shaped=taller, motion=moved)


def live_person(
    motion: Motion, shaped: ShapedBody, *, avatars: Path | None, masked: bool
) -> tuple[BodyFit, GrowingFit | None]:
    """The same of a live source, whose masks are yet to come.

    Args:
        motion: What has come of the poses.
        shaped: As their tracker had it in mind.
        avatars: See `person_of`.
        masked: Whether there will be masks that are not estimated.

    Returns:
        The body, and what fits the poses to it while they come, if that is needed.
    """
    person = shaped if avatars is None else read_person(avatars, shaped.body)
    foreign = is_foreign(motion, shaped)
    if not foreign and are_alike(person, shaped):
        return BodyFit(shaped=person, motion=motion), None
    words = FITTED_LIVE.format("masks" if masked else "pictures")
    fit = BodyFit(shaped=person, motion=motion, words=words)
    return fit, GrowingFit(person, motion.model, masked=masked)


def _check_height(person: ShapedBody, height_m: float | None) -> None:
    """Raises if a stated height is not the avatar's."""
    height_cm = 100.0 * height_of(person)
    if height_m is not None and abs(100.0 * height_m - height_cm) > SAME_CM:
        raise BadInput(
            f"--height-cm is {100.0 * height_m:.0f}, but the avatar in --out is {height_cm:.0f} cm "
            "tall, which was settled by its first video. Leave it out, or learn the avatar anew "
            "(--overwrite)."
        )

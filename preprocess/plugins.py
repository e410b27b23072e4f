"""Trackers and segmenters by name: this project's own, or others that packages register.

A tracker's networks find one person's key points and mask, frame by frame; a segmenter's find the
person's mask where poses are given. Both of this project's own are BlazePose; another package may
register one as an entry point.
"""

from importlib.metadata import entry_points
from typing import Any, Protocol, runtime_checkable

from capture.camera import Camera
from capture.input_error import InputError
from capture.source import AlphaMask, Frame, RgbImage
from preprocess.body.body_pose import BodyPose
from preprocess.body.parametric_body import ShapedBody
from preprocess.tracking.keypoints import PersonKeypoints

DEFAULT_TRACKER = "blazepose"
"""Name of this project's own tracker."""
SEGMENTER_PREFIX = "segmenter:"
"""Prefix of a segmenter's name in --masks."""
DEFAULT_SEGMENTER = "blazepose"
"""Name of this project's own segmenter."""


@runtime_checkable
class PersonTracker(Protocol):
    """Follows one person, frame by frame, in the order of the frames."""

    def __call__(self, rgb: RgbImage) -> PersonKeypoints | None:
        """Find the person in the next frame; None where there is none."""
        ...


@runtime_checkable
class Segmenter(Protocol):
    """Segments the person, frame by frame, in the order of the frames."""

    def __call__(self, frame: Frame, pose: BodyPose, camera: Camera) -> AlphaMask:
        """Estimate how far each pixel is person, in [0, 1]; the camera is of the frame's size."""
        ...


def segmenter_name(masks: object) -> str | None:
    """The name after `segmenter:` in --masks; None if it names a file or nothing."""
    text = str(masks)
    return text.removeprefix(SEGMENTER_PREFIX) if text.startswith(SEGMENTER_PREFIX) else None


def check_installed(tracker: str | None, segmenter: str | None) -> None:
    """Raise an InputError for a tracker or a segmenter that is not installed; load nothing."""
    if tracker not in (None, DEFAULT_TRACKER):
        _find_registered("tracker", tracker)
    if segmenter not in (None, DEFAULT_SEGMENTER):
        _find_registered("segmenter", segmenter)


def make_segmenter(name: str, shaped: ShapedBody) -> Segmenter:
    """Make this project's segmenter, or one of an installed package.

    Another package's entry point `make(shaped)` returns a Segmenter.
    """
    if name == DEFAULT_SEGMENTER:
        from preprocess.tracking.blazepose import BlazePoseSegmenter

        return BlazePoseSegmenter(shaped)
    return _make_registered("segmenter", name, shaped)


def make_tracker(name: str = DEFAULT_TRACKER, person: int | None = None) -> PersonTracker:
    """Make this project's tracker, or one of an installed package.

    Another package's entry point NAME = "module:make" lies in the group
    `instant_avatar.trackers`; `make(person)` returns a PersonTracker. `person` is the number of the
    person to follow, counted from left to right from 1, in the first frame with that many persons;
    the largest one if it is not given.
    """
    if name == DEFAULT_TRACKER:
        from preprocess.tracking.blazepose import BlazePoseTracker

        return BlazePoseTracker(person=person)
    return _make_registered("tracker", name, person)


def _make_registered(kind: str, name: str, *arguments: object) -> Any:
    """Make a "segmenter" or "tracker" that an installed package registers, or raise an InputError.

    `arguments` are those of its `make`.
    """
    point = _find_registered(kind, name)
    try:
        return point.load()(*arguments)
    except Exception as cause:  # code of another package
        raise InputError(f"The {kind} {name!r} could not be loaded: {cause}.") from cause


def _find_registered(kind: str, name: str) -> Any:
    """The entry point NAME = "module:make" in the group `instant_avatar.KINDs`."""
    group = f"instant_avatar.{kind}s"
    registered = {point.name: point for point in entry_points(group=group)}
    if name not in registered:
        own, option = DEFAULT_TRACKER, "--tracker "
        if kind == "segmenter":
            own, option = DEFAULT_SEGMENTER, f"--masks {SEGMENTER_PREFIX}"
        raise InputError(
            f"{option}{name}: there is no such {kind}; installed are "
            f"{', '.join([own, *registered])}. Others come with packages that have "
            f"an entry point in the group {group!r} (docs/formats.md)."
        )
    return registered[name]

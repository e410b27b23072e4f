"""Where masks come from if no file holds them: the seat for segmenters, ours and others'."""

from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from capture.camera import Camera
from capture.errors import InputError
from capture.frame import Frame
from preprocess.body import ShapedBody
from preprocess.pose import BodyPose

SEGMENTER_PREFIX = "segmenter:"
DEFAULT_SEGMENTER = "grabcut"
ENTRY_POINT_GROUP = "instant_avatar.segmenters"
"""Entry points of other packages: NAME = "module:make", where make(shaped) gives a Segmenter."""


@runtime_checkable
class Segmenter(Protocol):
    """Finds the person in a picture, frame by frame, in the order in which they come."""

    def __call__(
        self, frame: Frame, pose: BodyPose, camera: Camera
    ) -> Float32[np.ndarray, "height width"]:
        """How far each pixel of the picture is person, in [0, 1].

        Args:
            frame: The picture, of any size.
            pose: Where the tracker found the body.
            camera: Of the picture's size.
        """
        ...


SegmenterFactory = Callable[[ShapedBody], Segmenter]


def segmenter_name(masks: object) -> str | None:
    """What follows `segmenter:` in --masks; None if it names a file or nothing."""
    text = str(masks)
    return text.removeprefix(SEGMENTER_PREFIX) if text.startswith(SEGMENTER_PREFIX) else None


def make_segmenter(name: str, shaped: ShapedBody) -> Segmenter:
    """Our own segmenter, or that of an installed package.

    Raises:
        InputError: If no package brings one of that name, or it cannot be loaded.
    """
    if name == DEFAULT_SEGMENTER:
        from preprocess.masks.grabcut import GrabCutSegmenter

        return GrabCutSegmenter(shaped)
    brought = {point.name: point for point in entry_points(group=ENTRY_POINT_GROUP)}
    if name not in brought:
        raise InputError(
            f"--masks {SEGMENTER_PREFIX}{name}: there is no such segmenter; installed are "
            f"{', '.join([DEFAULT_SEGMENTER, *brought])}. Others come with packages that have an entry point in "
            f"the group {ENTRY_POINT_GROUP!r} (docs/formats.md)."
        )
    try:
        make: SegmenterFactory = brought[name].load()
        return make(shaped)
    except Exception as cause:  # somebody else's code
        raise InputError(f"The segmenter {name!r} could not be loaded: {cause}.") from cause

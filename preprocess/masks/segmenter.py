"""Where masks come from if no file holds them: the seat for segmenters, ours and others'."""

from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from capture.camera import Camera
from capture.errors import BadInput
from capture.frame import Frame
from preprocess.body import ShapedBody
from preprocess.pose import BodyPose

PREFIX = "segmenter:"
OURS = "grabcut"
GROUP = "instant_avatar.segmenters"
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


Maker = Callable[[ShapedBody], Segmenter]


def segmenter_name(masks: object) -> str | None:
    """What follows `segmenter:` in --masks; None if it names a file or nothing."""
    text = str(masks)
    return text.removeprefix(PREFIX) if text.startswith(PREFIX) else None


def make_segmenter(name: str, shaped: ShapedBody) -> Segmenter:
    """Our own segmenter, or that of an installed package.

    Raises:
        BadInput: If no package brings one of that name, or it cannot be loaded.
    """
    if name == OURS:
        from preprocess.masks.grabcut import GrabCut

        return GrabCut(shaped)
    brought = {point.name: point for point in entry_points(group=GROUP)}
    if name not in brought:
        raise BadInput(
            f"--masks {PREFIX}{name}: there is no such segmenter; installed are "
            f"{', '.join([OURS, *brought])}. Others come with packages that have an entry point in "
            f"the group {GROUP!r} (docs/formats.md)."
        )
    try:
        make: Maker = brought[name].load()
        return make(shaped)
    except Exception as cause:  # somebody else's code
        raise BadInput(f"The segmenter {name!r} could not be loaded: {cause}.") from cause

"""Where masks come from if no file holds them: the seat for segmenters, ours and others'.

Which masks a capture is learnt with: one decision for recordings and for live sources.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from capture.camera import Camera
from capture.frame import Frame
from capture.input_error import InputError
from preprocess.body.body_pose import BodyPose
from preprocess.body.parametric_body import ShapedBody

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


@dataclass(frozen=True, kw_only=True)
class MaskOrigin:
    """Where the masks come from: a file or folder, a segmenter, or else the alpha channel.

    Attributes:
        path: The file or folder; None if there is none.
        segmenter: Name of the segmenter that estimates them; None if nothing is estimated.
        named: Whether the user named it.
    """

    path: Path | None = None
    segmenter: str | None = None
    is_explicit: bool = False

    @property
    def uses_alpha_channel(self) -> bool:
        """Whether the pictures' own alpha channel is the mask."""
        return self.path is None and self.segmenter is None

    @property
    def is_fallback(self) -> bool:
        """Whether masks are estimated only because there are no others."""
        return self.segmenter is not None and not self.is_explicit


def choose_mask_origin(
    requested: Path | None, found: Path | None, *, has_alpha: bool
) -> MaskOrigin:
    """Takes what the user named; else a file that was found, the alpha channel, or an estimate.

    Args:
        given: What --masks names: a file, a folder, or `segmenter:NAME`.
        found: Masks that lie in the capture folder or beside the video.
        has_alpha: Whether the pictures' alpha channel cuts the person out; an opaque one does not.
    """
    segmenter = segmenter_name(requested)
    if segmenter is not None:
        return MaskOrigin(segmenter=segmenter, is_explicit=True)
    if requested is not None:
        return MaskOrigin(path=requested, is_explicit=True)
    if found is not None:
        return MaskOrigin(path=found)
    return MaskOrigin() if has_alpha else MaskOrigin(segmenter=DEFAULT_SEGMENTER)

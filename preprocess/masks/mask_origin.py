"""Where a capture's masks come from: files, the alpha channel, or a segmenter.

The segmenter may be this project's own or one that another package registers as an entry point.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from capture.camera import Camera
from capture.source import Frame
from preprocess.body.body_pose import BodyPose
from preprocess.body.parametric_body import ShapedBody
from preprocess.plugins import make_plugin

SEGMENTER_PREFIX = "segmenter:"
"""What precedes a segmenter's name in --masks."""
DEFAULT_SEGMENTER = "blazepose"
"""Name of this project's own segmenter."""


@runtime_checkable
class Segmenter(Protocol):
    """Segments the person, frame by frame, in the order of the frames."""

    def __call__(
        self, frame: Frame, pose: BodyPose, camera: Camera
    ) -> Float32[np.ndarray, "height width"]:
        """Estimate how far each pixel is person, in [0, 1].

        Args:
            frame: The frame, of any size.
            pose: The tracker's pose of the body.
            camera: Camera of the frame's size.
        """
        ...


def segmenter_name(masks: object) -> str | None:
    """The name after `segmenter:` in --masks; None if it names a file or nothing."""
    text = str(masks)
    return text.removeprefix(SEGMENTER_PREFIX) if text.startswith(SEGMENTER_PREFIX) else None


def make_segmenter(name: str, shaped: ShapedBody) -> Segmenter:
    """Make this project's segmenter, or one of an installed package.

    Another package's entry point `make(shaped)` returns a Segmenter.

    Raises:
        InputError: If no package registers that name, or its segmenter cannot be loaded.
    """
    if name == DEFAULT_SEGMENTER:
        from preprocess.blazepose.blazepose_segmenter import BlazePoseSegmenter

        return BlazePoseSegmenter(shaped)
    option = f"--masks {SEGMENTER_PREFIX}{name}"
    return make_plugin("segmenter", name, shaped, own=DEFAULT_SEGMENTER, option=option)


@dataclass(frozen=True, kw_only=True)
class MaskOrigin:
    """Where the masks come from: a file or folder, a segmenter, or else the alpha channel.

    Attributes:
        path: The file or folder; None if there is none.
        segmenter: Name of the segmenter that estimates them; None if nothing is estimated.
        is_explicit: Whether the user named it.
    """

    path: Path | None = None
    segmenter: str | None = None
    is_explicit: bool = False

    @property
    def uses_alpha_channel(self) -> bool:
        """Whether the images' own alpha channel is the mask."""
        return self.path is None and self.segmenter is None

    @property
    def is_fallback(self) -> bool:
        """Whether masks are estimated only because there are no others."""
        return self.segmenter is not None and not self.is_explicit


def choose_mask_origin(
    requested: Path | None, found: Path | None, *, has_alpha: bool
) -> MaskOrigin:
    """Choose what the user named; else a file that was found, the alpha channel, or an estimate.

    Args:
        requested: Value of --masks: a file, a folder, or `segmenter:NAME`.
        found: Masks in the capture folder or beside the video.
        has_alpha: Whether the images' alpha channel cuts the person out; an opaque one does not.
    """
    segmenter = segmenter_name(requested)
    if segmenter is not None:
        return MaskOrigin(segmenter=segmenter, is_explicit=True)
    if requested is not None:
        return MaskOrigin(path=requested, is_explicit=True)
    if found is not None:
        return MaskOrigin(path=found)
    return MaskOrigin() if has_alpha else MaskOrigin(segmenter=DEFAULT_SEGMENTER)

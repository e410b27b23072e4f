"""Options that several commands share: the parts of a capture, and which of its frames."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

from capture.input_error import InputError
from preprocess.capture_session import CaptureInputs

Flag = Annotated[bool, FlagCreatePairsOff, arg(help_behavior_hint="")]
"""A flag without its opposite."""


@dataclass(frozen=True, kw_only=True)
class CaptureArguments:
    """Options that name the parts of a capture; the text under each field is its --help."""

    video: Annotated[Positional[Path], arg(metavar="VIDEO")]
    """Video file, folder of images, or capture folder."""
    poses: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """SMPL poses: an .npz with global_orient, body_pose, transl (or poses, trans), or the output of
    4D-Humans, WHAM, VIBE, GVHMR, TRAM, PromptHMR, ROMP, BEV or EasyMocap (a file, or a folder of
    files); see docs/formats.md. Pickles are read without executing them. Default: tracked in the
    video."""
    person: Annotated[str | None, arg(metavar="ID", help_behavior_hint="")] = None
    """Person ID in the pose file (default: the longest track); without poses, which person to
    track: 1 is the leftmost (default: the one in front)."""
    masks: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Masks, one per frame, 255 where the person is: a folder of images, a video, an .npz, or COCO
    run-length codes. Default: tracked with the poses, or estimated from images and given poses
    (segmenter:blazepose); segmenter:NAME selects another installed segmenter."""
    mask_invert: Flag = False
    """Masks are dark where the person is (default: detected automatically)."""
    no_mask_invert: Flag = False
    """Masks are bright where the person is (default: detected automatically)."""
    cameras: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """A cameras.npz (intrinsic, extrinsic: one, or one per frame), a COLMAP model, a
    transforms.json, or an export of Record3D or Polycam; `static`: fixed camera with unknown focal
    length; or `solve`: moving camera, solved from the images (a minute or two, with pycolmap;
    docs/cameras.md). Poses are then relative to the camera of each frame."""
    body: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Your own SMPL body, .npz or .pkl (nothing in it is executed; default: the embedded body)."""
    frames: str = "::"
    """Frames to use: START:STOP:STEP, counted from 0."""

    def capture_inputs(self) -> CaptureInputs:
        """Return the inputs to open.

        Raises:
            InputError: If --frames cannot be parsed, or both mask flags were given.
        """
        if self.mask_invert and self.no_mask_invert:
            raise InputError("--mask-invert and --no-mask-invert are mutually exclusive.")
        return CaptureInputs(
            video=self.video,
            poses=self.poses,
            masks=self.masks,
            cameras=self.cameras,
            body=self.body,
            frames=parse_frame_range(self.frames),
            invert_masks=self.mask_invert if self.mask_invert or self.no_mask_invert else None,
            person=self.person,
        )


def capture_name(video: Path) -> str:
    """Return the name of a capture, after which its outputs are called."""
    place = video.resolve()
    return place.name if place.is_dir() else place.stem


def parse_frame_range(text: str) -> slice | None:
    """Parse START:STOP:STEP as a slice; None for all frames.

    Raises:
        InputError: If the text has another form.
    """
    if not re.fullmatch(r"\d*(:\d*){0,2}", text) or ":" not in text:
        raise InputError(
            f"--frames is {text!r}, but must be START:STOP:STEP counted from 0, as in 0:120:2 or "
            "30:."
        )
    parts = [int(part) if part else None for part in text.split(":")]
    return None if not any(part is not None for part in parts) else slice(*parts)


def format_frame_range(frames: slice | None) -> str:
    """Return the text that `parse_frame_range` parses."""
    parts = (None, None) if frames is None else (frames.start, frames.stop, frames.step)
    return ":".join("" if part is None else str(part) for part in parts)


def option_words(values: Mapping[str, object]) -> list[str]:
    """Return options as words of a command line; those that are None are left out."""
    given = {name: value for name, value in values.items() if value is not None}
    return [word for name, value in given.items() for word in (f"--{name}", str(value))]

"""Options that several commands share: the parts of a capture, and where outputs are written."""

import os
import re
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from capture.atomic_files import RESERVED_PREFIX, check_replaceable_folder, is_stream
from capture.input_error import InputError, quote_command
from capture.source import FrameSource
from capture.source_opening import describe_recording, open_source
from instant_avatar.cli.console import Console
from preprocess.capture_inputs import CaptureInputs

Flag = Annotated[bool, FlagCreatePairsOff, arg(help_behavior_hint="")]
"""A flag without its opposite."""
Switch = Annotated[bool, arg(help_behavior_hint="")]
"""A flag with its opposite."""
OptionalFile = Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")]
OptionalFolder = Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")]
OptionalCameras = Annotated[str | None, arg(metavar="FILE", help_behavior_hint="")]
OptionalId = Annotated[str | None, arg(metavar="ID", help_behavior_hint="")]
OptionalName = Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")]
OptionalCount = Annotated[int | None, arg(metavar="N", help_behavior_hint="")]
OptionalPixels = Annotated[int | None, arg(metavar="PX", help_behavior_hint="")]
"""Options whose help tells what holds without them."""
HOST = "127.0.0.1"
"""Loopback address: only browsers of this machine reach what a command serves."""


@dataclass(frozen=True, kw_only=True)
class CaptureArguments:
    """Options that name the parts of a capture; the text under each field is its --help."""

    video: Annotated[Positional[Path], arg(metavar="VIDEO")]
    """Video file, folder of images, or capture folder."""
    poses: OptionalFile = None
    """SMPL poses: an .npz with global_orient, body_pose, transl (or poses, trans), or the output of
    4D-Humans, WHAM, VIBE, GVHMR, TRAM, PromptHMR, ROMP, BEV or EasyMocap (a file, or a folder of
    files); see docs/formats.md. Pickles are read without executing them. Default: tracked in the
    video."""
    person: OptionalId = None
    """Person ID in the pose file (default: the longest track); without poses, which person to
    track: 1 is the leftmost (default: the largest)."""
    masks: OptionalFolder = None
    """Masks, one per frame, 255 where the person is: a folder of images, a video, or an .npz.
    Default: tracked with the poses, or estimated from images and given poses
    (segmenter:blazepose); segmenter:NAME selects another installed segmenter."""
    mask_invert: Flag = False
    """Masks are dark where the person is (default: detected automatically)."""
    no_mask_invert: Flag = False
    """Masks are bright where the person is (default: detected automatically)."""
    cameras: OptionalCameras = None
    """A cameras.npz (intrinsic, extrinsic: one, or one per frame), a COLMAP model, a
    transforms.json, or an export of Record3D or Polycam; `static`: fixed camera with unknown focal
    length; or `solve`: moving camera, solved from the images (a minute or two, with pycolmap;
    docs/cameras.md). Poses are then relative to the camera of each frame."""
    body: OptionalFile = None
    """Your own SMPL body, .npz or .pkl (nothing in it is executed; default: the embedded body)."""
    frames: str = "::"
    """Frames to use: START:STOP:STEP, counted from 0; ::1 for all, where poses are tracked."""
    rotate: Literal[0, 90, 180, 270] = 0
    """Turn each frame clockwise by this many degrees, where the video lies on its side or upside
    down. Poses, masks and cameras that are given must be those of the turned frames."""

    def capture_inputs(self) -> CaptureInputs:
        """Return the inputs to open."""
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
            rotate=self.rotate,
        )


USUAL_NAMES = frozenset({"video", "movie", "film", "clip", "images", "frames"})
"""Names of videos that say nothing about what they show."""


def open_recording(inputs: CaptureInputs, console: Console) -> FrameSource:
    """Open the video or the images of a capture, and print what they are."""
    source = open_source(inputs.video, frames=inputs.frames, rotate=inputs.rotate)
    console.info(describe_recording(source))
    return source


def capture_name(video: Path) -> str:
    """Return the name of a capture, or of its folder if its own says nothing."""
    place = video.resolve()
    name = place.name if place.is_dir() else place.stem
    return place.parent.name or name if name.lower() in USUAL_NAMES else name


def parse_frame_range(text: str) -> slice | None:
    """Parse START:STOP:STEP as a slice; None for all frames."""
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


def check_writable(path: Path, flag: str) -> None:
    """Refuse a file or folder that a trial shows cannot be written; nothing is left behind.

    It and its parents need not exist yet; `flag` is the argument that names it.
    """
    place = Path(os.path.abspath(path))
    while not place.exists() and place != place.parent:
        place = place.parent
    if place.is_file() and place.absolute() != Path(os.path.abspath(path)):
        raise InputError(f"{flag} is {path}, but {place} is a file.")
    folder = place.parent if place.is_file() else place  # a file is replaced, not written into
    try:
        os.rmdir(tempfile.mkdtemp(prefix=RESERVED_PREFIX, dir=folder))
    except OSError as error:
        raise InputError(
            f"{flag} is {path}, but {folder} is not writable ({error.strerror}). Choose another "
            "path."
        ) from None


def check_output_file(
    path: Path,
    flag: str,
    inputs: Iterable[Path] = (),
    *,
    overwrite: bool = False,
    below: bool = True,
) -> None:
    """Refuse an output file that exists already, cannot be written, or lies in an input.

    With `below` it may lie in a folder within an input; `flag` is the argument that names it.
    """
    if path.is_dir():
        raise InputError(f"{flag} is {path}, which is a folder, but must be a file.")
    if is_stream(path):
        return
    for given in inputs:
        clash = _describe_overlap(path, given)
        if clash == "is" or (clash == "lies in" and not below) or _is_same_file(path.parent, given):
            raise InputError(
                f"{flag} is {path}, which {clash} an input of this command ({given}); inputs are "
                f"never written to. Choose a file outside of it ({flag})."
            )
    if os.path.lexists(path) and not overwrite:
        raise InputError(
            f"{flag} {path} already exists. Pass --overwrite to replace it, or choose another "
            f"file: {flag} {quote_command(unused_path(path))}"
        )
    check_writable(path, flag)


def check_output_folder(path: Path, flag: str, inputs: Iterable[Path] = ()) -> None:
    """Refuse a folder that overlaps an input, cannot be written, or holds files of others."""
    check_disjoint_from_inputs(path, flag, inputs)
    check_replaceable_folder(path)
    check_writable(path, flag)


def check_disjoint_from_inputs(folder: Path, flag: str, inputs: Iterable[Path]) -> None:
    """Refuse an output folder that is an input, contains one, or lies in one."""
    for given in inputs:
        clash = _describe_overlap(folder, given)
        if clash is not None:
            raise InputError(
                f"{flag} {folder} {clash} an input of this command ({given.absolute()}): nothing "
                f"is written next to inputs. Choose a separate folder ({flag})."
            )


def unused_path(path: Path) -> Path:
    """Return the path, or its first numbered variant that does not exist."""
    number, free = 1, path
    while os.path.lexists(free):
        number += 1
        free = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return free


def _describe_overlap(folder: Path, given: Path) -> str | None:
    """Return how an output folder overlaps an input; None if it does not."""
    if _is_same_file(folder, given):
        return "is"
    if given.is_dir() and any(_is_same_file(above, given) for above in _real_path(folder).parents):
        return "lies in"
    if any(_is_same_file(above, folder) for above in _real_path(given).parents):
        return "contains"
    return None


def _is_same_file(one: Path, other: Path) -> bool:
    """True if two paths are one file, also by links, or on case-insensitive file systems."""
    if _real_path(one) == _real_path(other):
        return True
    try:
        return one.samefile(other)
    except OSError:  # one does not exist
        return False


def _real_path(path: Path) -> Path:
    return Path(os.path.realpath(path))

"""The ia-check command line that corrects a capture, complete enough to be pasted into a shell."""

import shlex
from pathlib import Path

from apps.recording.wanted import CaptureInputs


def check_command(inputs: CaptureInputs, *, fix: bool = True) -> str:
    """The command line with the user's own inputs.

    Args:
        wanted: What the user named.
        fix: Whether it writes a corrected copy, to a folder that is not there yet.
    """
    words = ["ia-check", str(inputs.video)]
    named = {
        "--poses": inputs.poses, "--masks": inputs.masks, "--cameras": inputs.cameras,
        "--body": inputs.body, "--person": inputs.person,
    }  # fmt: skip
    for option, value in named.items():
        words += [] if value is None else [option, str(value)]
    if inputs.invert_masks is not None:
        words.append("--mask-invert" if inputs.invert_masks else "--no-mask-invert")
    if inputs.frames is not None and inputs.frames != slice(None):
        chosen = (inputs.frames.start, inputs.frames.stop, inputs.frames.step)
        words.append("--frames=" + ":".join("" if n is None else str(n) for n in chosen))
    words += ["--fix", str(unused_corrected_folder(inputs.video))] if fix else []
    return shlex.join(words)


def unused_corrected_folder(video: Path) -> Path:
    """A folder beside a capture that is not there yet, named after it."""
    place = video if video.name else video.resolve()
    stem = place.name if place.is_dir() else place.stem
    number, folder = 1, place.parent / f"{stem}-corrected"
    while folder.exists():
        number += 1
        folder = place.parent / f"{stem}-corrected-{number}"
    return folder

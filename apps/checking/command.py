"""The ia-check command line that corrects a capture, complete enough to be pasted into a shell."""

import shlex
from pathlib import Path

from apps.recording.wanted import RecordingPaths


def check_command(wanted: RecordingPaths, *, fix: bool = True) -> str:
    """The command line with the user's own inputs.

    Args:
        wanted: What the user named.
        fix: Whether it writes a corrected copy, to a folder that is not there yet.
    """
    words = ["ia-check", str(wanted.video)]
    named = {
        "--poses": wanted.poses, "--masks": wanted.masks, "--cameras": wanted.cameras,
        "--body": wanted.body, "--person": wanted.person,
    }  # fmt: skip
    for option, value in named.items():
        words += [] if value is None else [option, str(value)]
    if wanted.mask_invert is not None:
        words.append("--mask-invert" if wanted.mask_invert else "--no-mask-invert")
    if wanted.frames is not None and wanted.frames != slice(None):
        chosen = (wanted.frames.start, wanted.frames.stop, wanted.frames.step)
        words.append("--frames=" + ":".join("" if n is None else str(n) for n in chosen))
    words += ["--fix", str(corrected_folder(wanted.video))] if fix else []
    return shlex.join(words)


def corrected_folder(video: Path) -> Path:
    """A folder beside a capture that is not there yet, named after it."""
    place = video if video.name else video.resolve()
    stem = place.name if place.is_dir() else place.stem
    number, folder = 1, place.parent / f"{stem}-corrected"
    while folder.exists():
        number += 1
        folder = place.parent / f"{stem}-corrected-{number}"
    return folder

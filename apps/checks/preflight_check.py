"""The ia-check command line that corrects a capture, complete enough to be pasted into a shell.

The check before a run begins: silent, a warning, or the reason why it should not begin.
"""

import shlex
from pathlib import Path

from apps.checks.capture_validation import (
    NO_KNOWN_MISTAKE,
    CaptureValidation,
    check_capture,
    check_opened_capture,
    passes_quick_check,
)
from apps.cli.console import Console
from capture.input_error import InputError
from capture.live.camera_device import camera_address
from preprocess.alignment.correction_search import GOOD_IOU
from preprocess.capture_session import Capture, CaptureInputs


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


def preflight_check(
    recording: Capture, inputs: CaptureInputs, console: Console, *, force: bool
) -> None:
    """Checks a few masks and pictures; only where they disagree, looks for the reason.

    Args:
        recording: What is to be learnt from; live sources are not touched.
        wanted: What the user named, for the command that corrects it.
        console: Where warnings go.
        force: Whether an unusable capture is warned of instead of refused.

    Raises:
        InputError: If body and masks disagree so much that nothing could be learnt.
    """
    if passes_quick_check(recording):
        return
    with console.status("poses, masks and pictures disagree; looking for the reason"):
        found = check_opened_capture(recording)
    causes = [cause for cause in found.causes if cause != "mask_polarity"]
    if found.verdict == "unusable":
        message = (
            f"Body and masks agree by {found.mask_iou:.2f} only (0 to 1; {GOOD_IOU} or more was "
            f"expected). {_explain(found)} {_suggest_command(found, inputs)}"
        )
        if not force:
            raise InputError(f"{message} Or go on all the same with --force.")
        console.warning(message)
    elif causes:
        but = ", but not with the pictures" if found.has_film_errors else ""
        console.warning(
            f"Body and masks agree by {found.mask_iou:.2f}{but}. {_explain(found)} "
            f"{_suggest_command(found, inputs)}"
        )


def correction_hint(inputs: CaptureInputs) -> str:
    """What might mend a capture that was refused for other reasons; empty if that is unknown."""
    if inputs.live or camera_address(inputs.video) is not None:
        return ""
    try:
        found = check_capture(inputs)
    except InputError:
        return ""
    return f"{_explain(found)} {_suggest_command(found, inputs)}" if found.causes else ""


def _explain(check: CaptureValidation) -> str:
    if check.diagnosis is None or not check.diagnosis.corrections:
        return NO_KNOWN_MISTAKE
    words = "; and ".join(cure.description for cure in check.diagnosis.corrections)
    return f"It looks as if {words}. {check.expected_improvement}".strip()


def _suggest_command(check: CaptureValidation, inputs: CaptureInputs) -> str:
    """The command that corrects it, or that shows it."""
    if check.causes:
        return f"To correct it: {check_command(inputs)}"
    return f"To look at it: {check_command(inputs, fix=False)}"

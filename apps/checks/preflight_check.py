"""Check of a capture before a run starts, with the ia-check command line that corrects it."""

import os
import shlex
from pathlib import Path

from apps.checks.capture_validation import (
    CaptureValidation,
    check_capture,
    check_opened_capture,
    passes_quick_check,
)
from apps.cli.capture_options import capture_name, format_frame_range, option_words
from apps.cli.console import Console
from apps.cli.output_paths import unused_path
from capture.camera_device import camera_address
from capture.input_error import InputError
from preprocess.alignment.correction_search import GOOD_IOU
from preprocess.capture_session import Capture, CaptureInputs


def check_command(inputs: CaptureInputs, *, fix: bool = True) -> str:
    """Return the ia-check command line for the user's inputs, ready for a shell.

    Args:
        inputs: Inputs as the user named them.
        fix: Whether to write a corrected copy to a new folder.
    """
    words = ["ia-check", str(inputs.video)]
    named = ("poses", "masks", "cameras", "body", "person")
    words += option_words({name: getattr(inputs, name) for name in named})
    if inputs.invert_masks is not None:
        words.append("--mask-invert" if inputs.invert_masks else "--no-mask-invert")
    if inputs.frames is not None and inputs.frames != slice(None):
        words.append(f"--frames={format_frame_range(inputs.frames)}")
    if fix:
        beside = Path(os.path.abspath(inputs.video)) if not inputs.video.name else inputs.video
        free = unused_path(beside.with_name(f"{capture_name(beside)}-corrected"))
        words += ["--fix", str(free)]
    return shlex.join(words)


def preflight_check(
    recording: Capture, inputs: CaptureInputs, console: Console, *, force: bool
) -> None:
    """Check a few masks and images; diagnose the capture only if they disagree.

    Args:
        recording: The capture; live sources are not checked.
        inputs: Inputs as the user named them, for the suggested command.
        console: Shows warnings.
        force: Whether to warn of an unusable capture instead of refusing it.

    Raises:
        InputError: If the capture is unusable.
    """
    if passes_quick_check(recording):
        return
    with console.status("poses, masks and images disagree; diagnosing"):
        found = check_opened_capture(recording)
    causes = [cause for cause in found.causes if cause != "mask_polarity"]
    if found.verdict == "unusable":
        message = (
            f"IoU of body and masks: {found.mask_iou:.2f} ({GOOD_IOU} or more expected). "
            f"{_explain(found)} {_suggest_command(found, inputs)}"
        )
        if not force:
            raise InputError(f"{message} To train anyway, pass --force.")
        console.warning(message)
    elif causes or (found.mask_iou or 0.0) < GOOD_IOU:
        but = " The masks do not match the images." if found.has_film_errors else ""
        console.warning(
            f"IoU of body and masks: {found.mask_iou:.2f}.{but} {_explain(found)} "
            f"{_suggest_command(found, inputs)}"
        )


def correction_hint(inputs: CaptureInputs) -> str:
    """Suggest a correction for a capture that could not be opened; empty if none is known."""
    if inputs.live or camera_address(inputs.video) is not None:
        return ""
    try:
        found = check_capture(inputs)
    except InputError:
        return ""
    return f"{_explain(found)} {_suggest_command(found, inputs)}" if found.causes else ""


def _explain(check: CaptureValidation) -> str:
    if check.diagnosis is None or not check.diagnosis.corrections:
        return check.unexplained
    words = "; and ".join(each.description for each in check.diagnosis.corrections)
    return f"Probable cause: {words}. {check.expected_improvement}".strip()


def _suggest_command(check: CaptureValidation, inputs: CaptureInputs) -> str:
    """Suggest the command that corrects the capture, or that shows it."""
    if check.causes:
        return f"To correct it: {check_command(inputs)}"
    return f"To inspect it: {check_command(inputs, fix=False)}"

"""The check before a run begins: silent, a warning, or the reason why it should not begin."""

from apps.checking.command import check_command
from apps.checking.examine import NO_KNOWN_MISTAKE, CaptureValidation, check_capture, check_opened_capture, passes_quick_check
from apps.recording.recording import Capture
from apps.recording.wanted import CaptureInputs
from apps.terminal.console import Console
from capture.camera_device import camera_address
from capture.errors import InputError
from preprocess.doctor.diagnosis import GOOD_IOU


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

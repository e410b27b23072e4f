"""The check before a run begins: silent, a warning, or the reason why it should not begin."""

from apps.checking.command import check_command
from apps.checking.examine import UNEXPLAINED, Examined, examine, examined, looks_well
from apps.recording.recording import Recording
from apps.recording.wanted import RecordingPaths
from apps.terminal.console import Console
from capture.camera_device import camera_address
from capture.errors import BadInput
from preprocess.doctor.diagnosis import GOOD


def first_look(
    recording: Recording, wanted: RecordingPaths, console: Console, *, force: bool
) -> None:
    """Checks a few masks and pictures; only where they disagree, looks for the reason.

    Args:
        recording: What is to be learnt from; live sources are not touched.
        wanted: What the user named, for the command that corrects it.
        console: Where warnings go.
        force: Whether an unusable capture is warned of instead of refused.

    Raises:
        BadInput: If body and masks disagree so much that nothing could be learnt.
    """
    if looks_well(recording):
        return
    with console.waiting("poses, masks and pictures disagree; looking for the reason"):
        found = examined(recording)
    causes = [cause for cause in found.causes if cause != "mask_polarity"]
    if found.verdict == "unusable":
        message = (
            f"Body and masks agree by {found.agreed:.2f} only (0 to 1; {GOOD} or more was "
            f"expected). {_reason(found)} {_what_to_do(found, wanted)}"
        )
        if not force:
            raise BadInput(f"{message} Or go on all the same with --force.")
        console.warn(message)
    elif causes:
        but = ", but not with the pictures" if found.film_errs else ""
        console.warn(
            f"Body and masks agree by {found.agreed:.2f}{but}. {_reason(found)} "
            f"{_what_to_do(found, wanted)}"
        )


def hint(wanted: RecordingPaths) -> str:
    """What might mend a capture that was refused for other reasons; empty if that is unknown."""
    if wanted.live or camera_address(wanted.video) is not None:
        return ""
    try:
        found = examine(wanted)
    except BadInput:
        return ""
    return f"{_reason(found)} {_what_to_do(found, wanted)}" if found.causes else ""


def _reason(found: Examined) -> str:
    if found.diagnosis is None or not found.diagnosis.cures:
        return UNEXPLAINED
    words = "; and ".join(cure.words for cure in found.diagnosis.cures)
    return f"It looks as if {words}. {found.promise}".strip()


def _what_to_do(found: Examined, wanted: RecordingPaths) -> str:
    """The command that corrects it, or that shows it."""
    if found.causes:
        return f"To correct it: {check_command(wanted)}"
    return f"To look at it: {check_command(wanted, fix=False)}"

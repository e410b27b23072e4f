"""What the doctor says before a run begins: nothing, a warning, or why it should not begin."""

from apps.checking.examine import Examined, examine, examined, looks_well
from apps.recording.recording import Recording
from apps.recording.wanted import RecordingPaths
from apps.terminal.console import Console
from capture.camera_device import camera_address
from capture.errors import BadInput

HOW = "Look with ia-check, mend it with ia-check --fix OUT, or go on all the same with --force."


def first_look(recording: Recording, console: Console, *, force: bool) -> None:
    """Glances at a few masks; only where they disagree with the body, looks for the reason.

    Args:
        recording: What is to be learnt from; live sources are not touched.
        console: Where warnings go.
        force: Whether an unusable capture is warned of instead of refused.

    Raises:
        BadInput: If body and masks disagree so much that nothing could be learnt.
    """
    if looks_well(recording):
        return
    with console.waiting("poses and masks disagree; looking for the reason"):
        found = examined(recording)
    if found.verdict == "unusable":
        message = f"Body and masks agree by {found.agreed:.2f} only (0 to 1). {_reason(found)}"
        if not force:
            raise BadInput(f"{message} {HOW}")
        console.warn(message)
    elif [cause for cause in found.causes if cause != "mask_polarity"]:
        console.warn(f"Body and masks agree by {found.agreed:.2f}. {_reason(found)}")


def hint(wanted: RecordingPaths) -> str:
    """What might mend a capture that was refused for other reasons; empty if nobody knows."""
    if wanted.live or camera_address(wanted.video) is not None:
        return ""
    try:
        found = examine(wanted)
    except BadInput:
        return ""
    return f"{_reason(found)} ia-check --fix OUT mends it." if found.causes else ""


def _reason(found: Examined) -> str:
    if found.diagnosis is None or not found.diagnosis.cures:
        return "None of the usual mistakes explains it."
    words = "; and ".join(cure.words for cure in found.diagnosis.cures)
    return f"It looks as if {words} (undone: {found.after:.2f})."

"""What a user should know of a result that is no avatar: what it is, and what to look at."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from apps.reporting.report import HeldOutStats, Report, format_psnr
from avatar.sharpness import MAX_MEASURABLE_BLUR, MIN_OVERLAP
from capture.camera_device import camera_address

MIN_STEPS_TO_JUDGE = 60
"""Below this many steps the avatar may simply not have had the time: fog clears in about 50."""
CHECK_OPTIONS = ("poses", "person", "masks", "cameras", "body")
"""Arguments of ia-ingest that ia-check needs to look at the same capture."""


def diagnose_failure(report: Report) -> str | None:
    """Why the result is no avatar of the person, and what to do; None if it is one."""
    if report.verdict != "failed":
        return None
    held = report.held_out_refined or report.held_out
    what = f"The result is no usable avatar: {_describe_scores(held)}."
    if report.training.steps < MIN_STEPS_TO_JUDGE:
        return (
            f"{what} Only {report.training.steps} steps were made: learn longer (the same command "
            "with --resume and more --seconds)."
        )
    return (
        f"{what} It has learnt something other than the person; masks that show too much, or poses "
        "of another video, are the usual causes. Compare video and avatar in report.html"
        + _check_advice(report.command)
    )


def _describe_scores(held: HeldOutStats) -> str:
    said = f"frames that it was not trained on are drawn at {format_psnr(held.psnr, held.verdict)}"
    if held.overlap is not None and held.overlap < MIN_OVERLAP:
        return (
            f"{said}, and the body that is drawn agrees with the masks by only {held.overlap:.2f} "
            f"(0 to 1; at least {MIN_OVERLAP:.1f} was expected)"
        )
    return (
        f"{said}, worse than the video itself blurred by {MAX_MEASURABLE_BLUR:.0%} of the person's height, in "
        "which no person can be made out"
    )


def _check_advice(command: Mapping[str, Any]) -> str:
    """The command that looks at poses and masks; of a live camera nothing is left to look at."""
    video = str(command.get("video"))
    if camera_address(Path(video)) is not None:
        return "."
    words = ["ia-check", video]
    for name in CHECK_OPTIONS:
        if command.get(name) not in (None, "solve"):
            words += [f"--{name}", str(command[name])]
    return f", and let poses and masks be checked: {shlex.join(words)}"

"""What a user should know of a result that is no avatar: what it is, and what to look at."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from apps.reporting.report import HeldOutNote, Report, decibels
from avatar.sharpness import BLURRED, LEAST_OVERLAP
from capture.camera_device import camera_address

FEW_STEPS = 60
"""Below this many steps the avatar may simply not have had the time: fog clears in about 50."""
ASKED_OF_CHECK = ("poses", "person", "masks", "cameras", "body")
"""Arguments of ia-ingest that ia-check needs to look at the same capture."""


def failure_of(report: Report) -> str | None:
    """Why the result is no avatar of the person, and what to do; None if it is one."""
    if report.verdict != "failed":
        return None
    held = report.held_out_refined or report.held_out
    what = f"The result is no usable avatar: {_finding(held)}."
    if report.training.steps < FEW_STEPS:
        return (
            f"{what} Only {report.training.steps} steps were made: learn longer (the same command "
            "with --resume and more --seconds)."
        )
    return (
        f"{what} It has learnt something other than the person; masks that show too much, or poses "
        "of another video, are the usual causes. Compare video and avatar in report.html"
        + _and_check(report.command)
    )


def _finding(held: HeldOutNote) -> str:
    said = f"frames that it was not trained on are drawn at {decibels(held.psnr, held.verdict)}"
    if held.overlap is not None and held.overlap < LEAST_OVERLAP:
        return (
            f"{said}, and the body that is drawn agrees with the masks by only {held.overlap:.2f} "
            f"(0 to 1; at least {LEAST_OVERLAP:.1f} was expected)"
        )
    return (
        f"{said}, worse than the video itself blurred by {BLURRED:.0%} of the person's height, in "
        "which no person can be made out"
    )


def _and_check(command: Mapping[str, Any]) -> str:
    """The command that looks at poses and masks; of a live camera nothing is left to look at."""
    video = str(command.get("video"))
    if camera_address(Path(video)) is not None:
        return "."
    words = ["ia-check", video]
    for name in ASKED_OF_CHECK:
        if command.get(name) not in (None, "solve"):
            words += [f"--{name}", str(command[name])]
    return f", and let poses and masks be checked: {shlex.join(words)}"

"""ia-check: diagnose a capture in seconds and suggest corrections."""

import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

from tyro.conf import arg

from capture.atomic_files import OutputFileList, write_text_atomically
from capture.input_error import InputError
from instant_avatar.capture_validation import (
    NO_KNOWN_MISTAKE,
    CaptureValidation,
    check_capture,
    check_command,
)
from instant_avatar.cli.command_line import BAD_INPUT, DONE, run_main
from instant_avatar.cli.console import Console
from instant_avatar.cli.shared_options import (
    CaptureArguments,
    Flag,
    OptionalFile,
    capture_name,
    check_disjoint_from_inputs,
    check_output_file,
    open_recording,
)
from instant_avatar.contact_sheet import write_contact_sheet
from instant_avatar.corrected_capture import check_new_or_empty, write_corrected_capture
from instant_avatar.run.person_tracking import grade_capture, print_doubts, track_person
from preprocess.alignment.correction_search import CorrectionCandidate
from preprocess.alignment.silhouette_objective import GOOD_IOU, mean_score
from preprocess.capture_inputs import CaptureInputs, InputKind
from preprocess.open_capture import ImportedCapture, read_capture

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
"""Formats of the contact sheet that --sheet names."""


@dataclass(frozen=True, kw_only=True)
class CheckArguments(CaptureArguments):
    """Diagnose a capture in seconds and suggest corrections. Nothing is trained.

    The body is projected with the given poses and camera and compared with the masks, and with key
    points that the built-in tracker finds in 16 images. If they disagree, known mistakes are tested
    one by one: poses late, early, backwards or at another frame rate, OpenGL axes, images rotated
    for the tracker, world and camera exchanged, a wrong focal length, left and right
    exchanged, EasyMocap's root, another size or unit, masks of the background or of a second
    person, and a video that was rotated, mirrored, cropped or cut on its own. The report names the
    mistake and the IoU after its correction (intersection over union, 0 to 1; good poses reach 0.75
    to 0.9, because clothes are wider than bodies).

    Try it:

        ia-check capture/

        ia-check video.mp4 --poses poses.npz --fix corrected/

    The contact sheet shows the mask's outline in white, the body's in orange, key points in cyan.

    Exit codes: 0 good, or usable with warnings (with --fix: after correction); 2 unusable or
    unreadable; 3 disk full; 130 Ctrl-C.
    """

    fix: Annotated[Path | None, arg(metavar="OUT", help_behavior_hint="")] = None
    """Write a corrected copy of the capture to this folder."""
    sheet: Annotated[Path | None, arg(metavar="PNG", help_behavior_hint="")] = None
    """Contact sheet to write (default: runs/NAME-check.png, named after the video)."""
    json: OptionalFile = None
    """Write the diagnosis to this file as JSON."""
    overwrite: Flag = False
    """Replace the files that --sheet and --json name, if they exist."""

    def capture_inputs(self) -> CaptureInputs:
        """Return the inputs to open; refuse a camera."""
        inputs = super().capture_inputs()
        if inputs.camera is not None:
            raise InputError(f"{self.video} is a camera, but ia-check needs a recording.")
        return inputs

    def check_outputs(self) -> None:
        """Refuse outputs that cannot be written."""
        inputs = self.capture_inputs().input_paths()
        if self.json is not None:
            check_output_file(self.json, "--json", inputs, overwrite=self.overwrite)
        if self.sheet is not None and self.sheet.suffix.lower() not in IMAGE_SUFFIXES:
            raise InputError(
                f"--sheet is {self.sheet}, but must end in {', '.join(IMAGE_SUFFIXES)}."
            )
        path = self.sheet_path()
        check_output_file(path, "--sheet", inputs, overwrite=self.may_replace_sheet)
        if self.fix is not None:
            check_disjoint_from_inputs(self.fix, "--fix", inputs)
            check_new_or_empty(self.fix)

    @property
    def may_replace_sheet(self) -> bool:
        """True if the sheet may replace a file: with --overwrite, or an earlier default one."""
        path = self.sheet_path()
        ours = self.sheet is None and OutputFileList(path.parent).owns(path.name)
        return self.overwrite or ours

    def sheet_path(self) -> Path:
        """Return the path of the contact sheet."""
        return self.sheet or Path("runs") / f"{capture_name(self.video)}-check.png"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main("ia-check", CheckArguments, check, argv)


def check(arguments: CheckArguments, console: Console) -> int:
    """Diagnose a capture, draw the contact sheet, and write a corrected copy for --fix."""
    inputs = arguments.capture_inputs()
    arguments.check_outputs()
    if inputs.kind is InputKind.POSED:
        return _check(arguments, lambda: read_capture(inputs), console)
    open_recording(inputs, console)
    with TemporaryDirectory() as folder:  # of the tracked masks
        tracking = track_person(inputs, Path(folder) / "poses.npz", console)
        return _check(arguments, lambda: tracking.imported, console)


def _check(arguments: CheckArguments, read: Callable[[], ImportedCapture], console: Console) -> int:
    try:
        with console.status("comparing poses, masks and cameras"):
            imported = read()
            check_result = check_capture(imported)
            grade = grade_capture(check_result.capture)
    except InputError as error:
        _write_json(arguments, refused_to_json(str(error)))
        raise
    _write_json(arguments, check_to_json(check_result) | {"tracking": grade and grade.as_json()})
    _print_findings(check_result, console)
    if grade is not None:
        print_doubts(grade, console)
        console.info(grade.describe())
    path, ours = arguments.sheet_path(), arguments.sheet is None
    if write_contact_sheet(path, check_result, replace=arguments.overwrite, listed=ours):
        console.print_artifact("look at it", path)
    else:
        console.warning(f"{path} was not written: no frame with a pose could be decoded.")
    if arguments.fix is not None:
        write_corrected_capture(check_result, arguments.fix)
        console.print_artifact("corrected", arguments.fix)
        return DONE if check_result.is_usable_after_fix else BAD_INPUT
    if check_result.causes and not check_result.is_auto_corrected:
        console.info(f"To correct it:  {check_command(imported.inputs)}")
    good = grade is None or grade.is_good_enough
    return DONE if good and check_result.verdict != "unusable" else BAD_INPUT


def _write_json(arguments: CheckArguments, content: dict[str, Any]) -> None:
    if arguments.json is not None:
        text = json.dumps(content, indent=1) + "\n"
        write_text_atomically(arguments.json, text, replace=arguments.overwrite)


def _json_number(value: float | None) -> float | None:
    """Round a number for JSON; NaN and infinity become null."""
    return None if value is None or not math.isfinite(value) else round(float(value), 4)


def check_to_json(check_result: CaptureValidation) -> dict[str, Any]:
    """Convert a diagnosis to JSON; IoUs are null without masks, `film` without key points."""
    diagnosis, masks = check_result.diagnosis, check_result.objective.masks
    of_masks = 0 if masks is None else len(masks.samples)
    now, after = map(check_result.keypoint_score, (check_result.geometry, diagnosis.corrected))

    def tried(key: str, rows: slice, *, of_video: bool) -> list[dict[str, Any]]:
        def entry(guess: CorrectionCandidate) -> dict[str, Any]:
            scores, correction = guess.frame_scores[rows], guess.correction
            score = _json_number(mean_score(scores) if len(scores) else None)
            return {"cause": correction.cause, key: score, "words": correction.description}

        return [entry(c) for c in diagnosis.candidates if c.correction.is_of_video == of_video]

    return refused_to_json(check_result.refusal) | {
        "verdict": check_result.verdict,
        "cause": check_result.causes[0] if check_result.causes else None,
        "iou": {
            "now": _json_number(check_result.stored_iou),
            "after_fix": _json_number(check_result.corrected_iou),
        },
        "tried": tried("iou", slice(0, of_masks), of_video=False),
        "film": None
        if now is None
        else {
            "now": _json_number(now),
            "after_fix": _json_number(after),
            "tried": tried("score", slice(of_masks, None), of_video=True),
        },
        "corrections": [
            {"cause": cure.cause, "words": cure.description} for cure in diagnosis.corrections
        ],
        "anomalies": list(check_result.anomalies),
    }


def refused_to_json(reason: str | None) -> dict[str, Any]:
    """Return the JSON of a capture of which nothing but this is known."""
    return {
        "format": 1, "verdict": "unusable", "cause": None,
        "iou": {"now": None, "after_fix": None}, "tried": [], "corrections": [], "anomalies": [],
        "refused": reason, "edges": None, "film": None, "tracking": None,
    }  # fmt: skip


def _print_findings(check_result: CaptureValidation, console: Console) -> None:
    for note in check_result.capture.notes:
        console.warning(note)
    for sentence in (*check_result.capture.source.warnings, *check_result.anomalies):
        console.warning(sentence)
    if check_result.refusal is not None:
        console.info(f"ia-ingest would refuse this capture: {check_result.refusal}")
    if check_result.is_auto_corrected:
        console.info(
            f"{check_result.verdict}: IoU of body and masks: {check_result.corrected_iou:.2f}. The "
            "masks are bright in the background (mask_polarity); ia-ingest inverts them "
            "automatically, so nothing needs to be done."
        )
        return
    console.info(f"{check_result.verdict}: {check_result.agreement}")
    for correction in check_result.diagnosis.corrections:
        console.info(f"Probable cause: {correction.description} ({correction.cause}).")
    if check_result.causes:
        console.info(check_result.expected_improvement)
    elif check_result.verdict != "good" and check_result.stored_iou >= GOOD_IOU:
        console.info("Poses and masks match where both exist; see the warnings above.")
    elif check_result.verdict != "good":
        console.info(NO_KNOWN_MISTAKE)


if __name__ == "__main__":
    sys.exit(main())

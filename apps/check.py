"""ia-check: says in seconds what is wrong with a capture, and how to mend it."""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import FlagCreatePairsOff, Positional, arg

from apps.checks.capture_validation import (
    GOOD_EDGE_RATIO,
    NO_KNOWN_MISTAKE,
    CaptureValidation,
    check_capture,
    json_number,
)
from apps.checks.contact_sheet import write_contact_sheet
from apps.checks.corrected_capture import check_new_or_empty, write_corrected_capture
from apps.checks.preflight_check import check_command
from apps.cli.capture_options import mask_inversion, parse_frame_range
from apps.cli.command_line import parse_arguments
from apps.cli.console import Console
from apps.cli.exit_codes import BAD_INPUT, DONE, run_command
from apps.cli.output_paths import check_disjoint_from_inputs, check_output_file
from capture.atomic_files import write_text_atomically
from capture.input_error import InputError
from capture.live.camera_device import camera_address
from preprocess.alignment.correction_search import GOOD_IOU, USABLE_IOU
from preprocess.capture_session import CaptureInputs

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
"""How the name of a picture that --sheet names may end."""

Flag = Annotated[bool, FlagCreatePairsOff, arg(help_behavior_hint="")]


@dataclass(frozen=True, kw_only=True)
class CheckArguments:
    """Says in seconds what is wrong with a capture, and how to mend it. Nothing is trained.

    The body is drawn where poses and camera say, and held against the masks. Where they disagree,
    the usual mistakes are undone one after another: poses late or early, of another frame rate or
    backwards, OpenGL's axes, pictures rotated for the tracker, degrees, world and camera mixed up,
    a wrong focal length, left for right, EasyMocap's root, another size or unit, masks of the
    background or of a second person. Then the masks' outlines are held against edges in the
    pictures: was the film alone rotated, mirrored, cropped or cut afterwards? Without masks the
    body's outline is. The mistake is named, with the agreement that correcting it would bring
    (intersection over union, 0 to 1; 0.75 to 0.9 is what good poses reach, as clothes are wider
    than bodies).

    Try it:

        ia-check capture/

        ia-check video.mp4 --poses poses.npz --fix corrected/

    Look at the sheet it draws: white is the mask (if there is one), orange the body.

    Exit codes: 0 good, or not so good but usable (with --fix: once mended); 2 unusable or
    unreadable; 3 disk full; 130 Ctrl-C.
    """

    video: Annotated[Positional[Path], arg(metavar="VIDEO")]
    """Video file, folder of pictures, or capture folder."""
    poses: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """SMPL poses, as ia-ingest takes them."""
    masks: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Masks, as ia-ingest takes them."""
    mask_invert: Flag = False
    """The person is dark in the masks."""
    no_mask_invert: Flag = False
    """The person is bright in the masks."""
    cameras: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Cameras, as ia-ingest takes them."""
    body: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Your own SMPL body; else the embedded one."""
    frames: str = "::"
    """Which frames, START:STOP:STEP, counted from 0."""
    person: Annotated[str | None, arg(metavar="ID", help_behavior_hint="")] = None
    """Whose poses, where the file holds several people's; else the longest track."""
    fix: Annotated[Path | None, arg(metavar="OUT", help_behavior_hint="")] = None
    """Write the capture with the named cures applied to this folder."""
    sheet: Annotated[Path | None, arg(metavar="PNG", help_behavior_hint="")] = None
    """Where the sheet of pictures goes; without it runs/NAME-check.png, after the video."""
    json: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Write what was found to this file."""
    overwrite: Flag = False
    """Replace the files that --sheet and --json name, if they are there."""

    def capture_inputs(self) -> CaptureInputs:
        """What is to be opened.

        Raises:
            InputError: If the arguments contradict each other.
        """
        if camera_address(self.video) is not None:
            raise InputError(f"{self.video} is a camera; a recording was expected.")
        return CaptureInputs(
            video=self.video,
            poses=self.poses,
            masks=self.masks,
            cameras=self.cameras,
            body=self.body,
            frames=parse_frame_range(self.frames),
            invert_masks=mask_inversion(
                person_dark=self.mask_invert, person_bright=self.no_mask_invert
            ),
            person=self.person,
        )

    def check_outputs(self) -> None:
        """Whether what is found can be written where it should go.

        Raises:
            InputError: If not.
        """
        inputs = self.capture_inputs().input_paths()
        if self.json is not None:
            check_output_file(self.json, "--json", inputs, overwrite=self.overwrite)
        if self.sheet is not None and self.sheet.suffix.lower() not in IMAGE_SUFFIXES:
            raise InputError(
                f"--sheet is {self.sheet}; a name in {', '.join(IMAGE_SUFFIXES)} was expected."
            )
        check_output_file(self.sheet_path(), "--sheet", inputs, overwrite=self.overwrite)
        if self.fix is not None:
            check_disjoint_from_inputs(self.fix, "--fix", inputs)
            check_new_or_empty(self.fix)

    def sheet_path(self) -> Path:
        """Where the sheet goes."""
        name = self.video.resolve()
        own = name.name if name.is_dir() else name.stem
        return self.sheet or Path("runs") / f"{own}-check.png"


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    given = parse_arguments(CheckArguments, "ia-check", argv)
    return run_command("ia-check", lambda: check(given, Console()))


def check(arguments: CheckArguments, console: Console) -> int:
    """Does what the arguments say.

    Raises:
        InputError: If there is nothing that can be examined, or nothing to mend where --fix asks.
        OSError: If something cannot be written.
    """
    wanted = arguments.capture_inputs()
    arguments.check_outputs()
    try:
        with console.status("looking at poses, masks and cameras"):
            examined = check_capture(wanted)
    except InputError as error:
        if arguments.json is not None:
            write_text_atomically(
                arguments.json, json.dumps(unreadable_to_json(str(error)), indent=1) + "\n",
                replace=arguments.overwrite,
            )  # fmt: skip
        raise
    if arguments.json is not None:
        text = json.dumps(check_to_json(examined), indent=1) + "\n"
        write_text_atomically(arguments.json, text, replace=arguments.overwrite)
    _print_findings(examined, console)
    path, ours = arguments.sheet_path(), arguments.sheet is None
    if write_contact_sheet(path, examined, replace=arguments.overwrite, listed=ours):
        console.print_artifact("look at it", path)
    else:
        console.warning(f"{path} was not written: no frame with a pose could be decoded.")
    if arguments.fix is not None:
        write_corrected_capture(examined, arguments.fix)
        console.print_artifact("corrected", arguments.fix)
        return DONE if examined.corrected_iou >= USABLE_IOU else BAD_INPUT
    if examined.causes and not examined.is_auto_corrected:
        console.info(f"To correct it:  {check_command(wanted)}")
    return BAD_INPUT if examined.verdict == "unusable" else DONE


def check_to_json(examined: CaptureValidation) -> dict[str, Any]:
    """What was found; agreements are null where there are no masks, `edges` where there are."""
    diagnosis = examined.diagnosis
    cures = diagnosis.corrections if diagnosis else ()
    tried = diagnosis.candidates if diagnosis else ()
    film = diagnosis.video if diagnosis else None
    return {
        "format": 1,
        "verdict": examined.verdict,
        "cause": examined.causes[0] if examined.causes else None,
        "iou": {
            "now": json_number(examined.stored_iou),
            "after_fix": json_number(examined.corrected_iou),
        },
        "tried": [
            {
                "cause": guess.correction.cause,
                "iou": json_number(guess.mean_score),
                "words": guess.correction.description,
            }
            for guess in tried
        ],
        "film": None
        if film is None
        else {
            "now": json_number(film.score_before),
            "after_fix": json_number(film.score_after),
            "tried": [
                {
                    "cause": guess.correction.cause,
                    "score": json_number(guess.mean_score),
                    "words": guess.correction.description,
                }
                for guess in film.candidates
            ],
        },
        "corrections": [{"cause": cure.cause, "words": cure.description} for cure in cures],
        "anomalies": list(examined.anomalies),
        "refused": examined.refusal,
        "edges": json_number(examined.edge_ratio),
    }


def unreadable_to_json(reason: str) -> dict[str, Any]:
    """The same for what could not even be opened."""
    return {
        "format": 1, "verdict": "unusable", "cause": None,
        "iou": {"now": None, "after_fix": None}, "tried": [], "corrections": [], "anomalies": [],
        "refused": reason, "edges": None, "film": None,
    }  # fmt: skip


def _print_findings(examined: CaptureValidation, console: Console) -> None:
    for note in examined.recording.notes:
        console.warning(note)
    for sentence in (*examined.recording.source.warnings, *examined.anomalies):
        console.warning(sentence)
    if examined.refusal is not None:
        console.info(f"ia-ingest would refuse it: {examined.refusal}")
    if examined.diagnosis is None:
        console.info(_describe_without_masks(examined))
        return
    if examined.is_auto_corrected:
        console.info(
            f"{examined.verdict}: body and masks agree by {examined.corrected_iou:.2f} (0 to 1). The masks "
            "show the background in white (mask_polarity); ia-ingest inverts such masks by itself, "
            "so nothing needs to be done."
        )
        return
    but = ", but not with the pictures" if examined.has_film_errors else ""
    console.info(
        f"{examined.verdict}: body and masks agree by {examined.stored_iou:.2f} (0 to 1){but}."
    )
    for cure in examined.diagnosis.corrections:
        console.info(f"It looks as if {cure.description} ({cure.cause}).")
    if examined.causes:
        console.info(examined.expected_improvement)
    elif examined.verdict != "good" and examined.stored_iou >= GOOD_IOU:
        console.info("They fit in the frames that have both; the warnings above name the problem.")
    elif examined.verdict != "good":
        console.info(NO_KNOWN_MISTAKE)


def _describe_without_masks(examined: CaptureValidation) -> str:
    """What can be said of a capture whose masks ia-ingest will have to estimate."""
    if examined.edge_ratio is None:
        return "There are no masks, and no picture could be looked at."
    fits = examined.edge_ratio >= GOOD_EDGE_RATIO
    return (
        f"{examined.verdict}: there are no masks (ia-ingest estimates some from poses and "
        f"pictures), so the pictures' own edges were compared with the body's outline: along it "
        f"the picture changes {examined.edge_ratio:.1f} times as much as beside it. The poses "
        + (
            "fit (2 to 5 times where they do, about 1 where they do not)."
            if fits
            else "hardly fit (2 to 5 times was expected, about 1 is chance). Give --masks to find "
            "out what is wrong."
        )
    )


if __name__ == "__main__":
    sys.exit(main())

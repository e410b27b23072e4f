"""ia-check: says in seconds what is wrong with a capture, and how to mend it."""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import FlagCreatePairsOff, Positional, arg

from apps.checking.command import check_command
from apps.checking.examine import GOOD_EDGES, UNEXPLAINED, Examined, examine, share
from apps.checking.mended import check_new_folder, write_mended
from apps.checking.sheet import write_sheet
from apps.ingest_arguments import parsed_frames, polarity
from apps.recording.wanted import RecordingPaths
from apps.terminal.command_line import parsed
from apps.terminal.console import Console
from apps.terminal.exit_codes import BAD_INPUT, DONE, exit_code
from apps.terminal.places import check_apart, check_file_place
from capture.atomic_files import write_text
from capture.camera_device import camera_address
from capture.errors import BadInput
from preprocess.doctor.diagnosis import GOOD, USABLE

SHEETS = (".png", ".jpg", ".jpeg", ".webp")
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

    def wanted(self) -> RecordingPaths:
        """What is to be opened.

        Raises:
            BadInput: If the arguments contradict each other.
        """
        if camera_address(self.video) is not None:
            raise BadInput(f"{self.video} is a camera; a recording was expected.")
        return RecordingPaths(
            video=self.video,
            poses=self.poses,
            masks=self.masks,
            cameras=self.cameras,
            body=self.body,
            frames=parsed_frames(self.frames),
            mask_invert=polarity(dark=self.mask_invert, bright=self.no_mask_invert),
            person=self.person,
        )

    def check_places(self) -> None:
        """Whether what is found can be written where it should go.

        Raises:
            BadInput: If not.
        """
        inputs = self.wanted().inputs()
        if self.json is not None:
            check_file_place(self.json, "--json", inputs, overwrite=self.overwrite)
        if self.sheet is not None and self.sheet.suffix.lower() not in SHEETS:
            raise BadInput(f"--sheet is {self.sheet}; a name in {', '.join(SHEETS)} was expected.")
        check_file_place(self.sheet_path(), "--sheet", inputs, overwrite=self.overwrite)
        if self.fix is not None:
            check_apart(self.fix, "--fix", inputs)
            check_new_folder(self.fix)

    def sheet_path(self) -> Path:
        """Where the sheet goes."""
        name = self.video.resolve()
        own = name.name if name.is_dir() else name.stem
        return self.sheet or Path("runs") / f"{own}-check.png"


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    given = parsed(CheckArguments, "ia-check", arguments)
    return exit_code("ia-check", lambda: check(given, Console()))


def check(given: CheckArguments, console: Console) -> int:
    """Does what the arguments say.

    Raises:
        BadInput: If there is nothing that can be examined, or nothing to mend where --fix asks.
        OSError: If something cannot be written.
    """
    wanted = given.wanted()
    given.check_places()
    try:
        with console.waiting("looking at poses, masks and cameras"):
            examined = examine(wanted)
    except BadInput as error:
        if given.json is not None:
            write_text(
                given.json, json.dumps(unreadable(str(error)), indent=1) + "\n",
                replace=given.overwrite,
            )  # fmt: skip
        raise
    if given.json is not None:
        text = json.dumps(as_json(examined), indent=1) + "\n"
        write_text(given.json, text, replace=given.overwrite)
    _say(examined, console)
    path, ours = given.sheet_path(), given.sheet is None
    if write_sheet(path, examined, replace=given.overwrite, listed=ours):
        console.made("look at it", path)
    else:
        console.warn(f"{path} was not written: no frame with a pose could be decoded.")
    if given.fix is not None:
        write_mended(examined, given.fix)
        console.made("corrected", given.fix)
        return DONE if examined.after >= USABLE else BAD_INPUT
    if examined.causes and not examined.mends_itself:
        console.say(f"To correct it:  {check_command(wanted)}")
    return BAD_INPUT if examined.verdict == "unusable" else DONE


def as_json(examined: Examined) -> dict[str, Any]:
    """What was found; agreements are null where there are no masks, `edges` where there are."""
    diagnosis = examined.diagnosis
    cures = diagnosis.cures if diagnosis else ()
    tried = diagnosis.tried if diagnosis else ()
    film = diagnosis.film if diagnosis else None
    return {
        "format": 1,
        "verdict": examined.verdict,
        "cause": examined.causes[0] if examined.causes else None,
        "iou": {"now": share(examined.now), "after_fix": share(examined.after)},
        "tried": [
            {"cause": guess.cure.cause, "iou": share(guess.iou), "words": guess.cure.words}
            for guess in tried
        ],
        "film": None
        if film is None
        else {
            "now": share(film.now),
            "after_fix": share(film.after),
            "tried": [
                {"cause": guess.cure.cause, "score": share(guess.iou), "words": guess.cure.words}
                for guess in film.tried
            ],
        },
        "cures": [{"cause": cure.cause, "words": cure.words} for cure in cures],
        "odd": list(examined.odd),
        "refused": examined.refused,
        "edges": share(examined.edges),
    }


def unreadable(why: str) -> dict[str, Any]:
    """The same for what could not even be opened."""
    return {
        "format": 1, "verdict": "unusable", "cause": None,
        "iou": {"now": None, "after_fix": None}, "tried": [], "cures": [], "odd": [],
        "refused": why, "edges": None, "film": None,
    }  # fmt: skip


def _say(examined: Examined, console: Console) -> None:
    for note in examined.recording.notes:
        console.warn(note)
    for sentence in (*examined.recording.source.warnings, *examined.odd):
        console.warn(sentence)
    if examined.refused is not None:
        console.say(f"ia-ingest would refuse it: {examined.refused}")
    if examined.diagnosis is None:
        console.say(_without_masks(examined))
        return
    if examined.mends_itself:
        console.say(
            f"{examined.verdict}: body and masks agree by {examined.after:.2f} (0 to 1). The masks "
            "show the background in white (mask_polarity); ia-ingest inverts such masks by itself, "
            "so nothing needs to be done."
        )
        return
    but = ", but not with the pictures" if examined.film_errs else ""
    console.say(f"{examined.verdict}: body and masks agree by {examined.now:.2f} (0 to 1){but}.")
    for cure in examined.diagnosis.cures:
        console.say(f"It looks as if {cure.words} ({cure.cause}).")
    if examined.causes:
        console.say(examined.promise)
    elif examined.verdict != "good" and examined.now >= GOOD:
        console.say("They fit in the frames that have both; the warnings above name the problem.")
    elif examined.verdict != "good":
        console.say(UNEXPLAINED)


def _without_masks(examined: Examined) -> str:
    """What can be said of a capture whose masks ia-ingest will have to estimate."""
    if examined.edges is None:
        return "There are no masks, and no picture could be looked at."
    fits = examined.edges >= GOOD_EDGES
    return (
        f"{examined.verdict}: there are no masks (ia-ingest estimates some from poses and "
        f"pictures), so the pictures' own edges were compared with the body's outline: along it "
        f"the picture changes {examined.edges:.1f} times as much as beside it. The poses "
        + (
            "fit (2 to 5 times where they do, about 1 where they do not)."
            if fits
            else "hardly fit (2 to 5 times was expected, about 1 is chance). Give --masks to find "
            "out what is wrong."
        )
    )


if __name__ == "__main__":
    sys.exit(main())

"""Poses and masks that are tracked in the video of a run, and kept in its folder tracking/."""

import json
from contextlib import suppress
from dataclasses import replace
from typing import Any

from capture.atomic_files import OutputFileList, write_text_atomically
from capture.input_error import InputError, counted
from instant_avatar.cli.command_line import INTERRUPTED, CommandExit, stop_on_interrupt
from instant_avatar.cli.console import Console
from instant_avatar.run.ingest_arguments import IngestArguments
from instant_avatar.run.person_tracking import (
    FitFunction,
    fit_in_process,
    print_doubts,
    track_person,
    tracked_inputs,
)
from instant_avatar.run.run_folder import RunFolder, listing_outputs
from instant_avatar.tracked_video import write_tracked_video
from preprocess.capture_inputs import CaptureInputs, find_own_poses
from preprocess.capture_session import Provenance
from preprocess.open_capture import ImportedCapture, read_capture

FORCE = "the same command with --resume --force"
"""How a run goes on with poses that are not good enough."""


def import_tracked(
    arguments: IngestArguments,
    inputs: CaptureInputs,
    run: RunFolder,
    console: Console,
    fit: FitFunction = fit_in_process,
) -> ImportedCapture:
    """Track the person of a recording for a run; of a resumed run, read its own tracking.

    Poses are written to the run's folder tracking/, as ia-track writes them. After Ctrl-C that
    folder holds the frames before it, and a resumed run goes on with the next.
    Poses that are not good enough are refused, but kept with the tracked video.
    """
    stored = _read_stored(arguments, run) if arguments.resume else None
    if stored is not None and stored["complete"]:
        if not (stored["grade"]["good_enough"] or arguments.force or run.has_checkpoint()):
            raise _refusal(stored["grade"]["summary"], run)
        return _with_grade(read_capture(_stored_inputs(stored, inputs, run)), stored)
    beside = find_own_poses(inputs.video.parent)
    if beside is not None:
        console.warning(f"{beside} lies beside the video; to use it, pass --poses.")
    keeping = "keeping the frames that were tracked"
    with stop_on_interrupt(console, keeping) as stop, listing_outputs(run.tracking):
        tracking = track_person(
            inputs, run.tracked_poses, console,
            stop=stop, resume=stored is not None, for_learning=True, fit=fit,
        )  # fmt: skip
    imported, grade = tracking.imported, tracking.grade
    chosen = imported.inputs.frames
    stored = {
        "request": _describe_request(arguments),
        "frames": None if chosen is None else [chosen.start, chosen.stop, chosen.step],
        "masks": imported.inputs.masks == run.tracking / "masks",
        "grade": grade.as_json(),
        "complete": not tracking.interrupted,
    }
    write_text_atomically(run.tracking_grade, json.dumps(stored, indent=1) + "\n")
    if stop.is_set():
        raise CommandExit(
            f"stopped by Ctrl-C. {counted(grade.frames, 'tracked frame')} kept in {run.tracking}: "
            "to go on from there, run the same command with --resume.",
            INTERRUPTED,
        )
    print_doubts(grade, console)
    if not (grade.is_good_enough or arguments.force):
        with console.status("drawing the tracked video"):
            write_tracked_video(run.tracked_video, tracking.capture(), grade.doubts)
        raise _refusal(grade.describe(), run)
    console.info(grade.describe())
    return _with_grade(imported, stored)


def _refusal(verdict: str, run: RunFolder) -> InputError:
    return InputError(
        f"{verdict} The tracked video is {run.tracked_video}. Look at it and film again, or give "
        f"--poses of another tracker. To train anyway: {FORCE}."
    )


def inputs_as_tracked(
    arguments: IngestArguments, inputs: CaptureInputs, run: RunFolder
) -> CaptureInputs:
    """Return a finished run's inputs with the poses that were tracked for it, if any were."""
    stored = _read_stored(arguments, run)
    return inputs if stored is None else _stored_inputs(stored, inputs, run)


def _stored_inputs(stored: dict[str, Any], inputs: CaptureInputs, run: RunFolder) -> CaptureInputs:
    if stored["frames"] is not None:
        inputs = replace(inputs, frames=slice(*stored["frames"]))
    masks = run.tracking / "masks" if stored["masks"] else None
    return tracked_inputs(inputs, run.tracked_poses, masks)


def _with_grade(imported: ImportedCapture, stored: dict[str, Any]) -> ImportedCapture:
    tracking = Provenance("tracking", "tracking/", uncertainty=1.0, figures=stored["grade"])
    return replace(imported, provenance=(tracking,))


def remove_tracking(run: RunFolder) -> None:
    """Remove what was tracked for a run."""
    for folder in (run.tracking / "masks", run.tracking):
        OutputFileList(folder).remove_all()
        with suppress(OSError):  # not empty, or missing
            folder.rmdir()


def _describe_request(arguments: IngestArguments) -> dict[str, Any]:
    """Return what decides the tracked poses; those of another request are tracked again."""
    named = {
        name: str(value)
        for name, value in vars(arguments).items()
        if name in ("masks", "cameras", "body", "frames", "person", "tracker", "rotate")
        and value is not None
    }
    return _without_defaults({"video": str(arguments.video.resolve()), **named})


def _without_defaults(request: dict[str, Any]) -> dict[str, Any]:
    """Leave out options that were not given, so that later ones change no earlier request."""
    return {name: value for name, value in request.items() if value not in (None, "0")}


def _read_stored(arguments: IngestArguments, run: RunFolder) -> dict[str, Any] | None:
    """Return what was tracked for the run and its request before; None if there is no such."""
    try:
        stored = json.loads(run.tracking_grade.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    expected = {"request", "frames", "masks", "grade", "complete"}
    usable = isinstance(stored, dict) and stored.keys() == expected and run.tracked_poses.is_file()
    same = usable and _without_defaults(stored["request"]) == _describe_request(arguments)
    return stored if same else None

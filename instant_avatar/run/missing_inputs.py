"""Inputs that a capture lacks: poses and masks tracked in its video, and cameras solved from it.

A video without poses is tracked first; a resumed run reads its own tracking. Then the cameras of a
phone that was carried around the person are solved, and written next to the avatar.
"""

import json
import os
import threading
from contextlib import suppress
from dataclasses import replace
from typing import Any

from capture.atomic_files import OutputFileList, atomic_file, write_text_atomically
from capture.input_error import InputError, quote_command
from capture.source_opening import reopen
from instant_avatar.cli.command_line import INTERRUPTED, CommandExit, stop_on_interrupt
from instant_avatar.cli.console import Console
from instant_avatar.cli.shared_options import format_frame_range
from instant_avatar.run.ingest_arguments import IngestArguments
from instant_avatar.run.person_tracking import (
    PersonTracking,
    needs_tracking,
    print_grade,
    track_person,
)
from instant_avatar.run.run_folder import RunFolder
from preprocess.cameras.camera_file import write_cameras
from preprocess.capture_paths import find_own_poses
from preprocess.capture_session import Capture, CaptureInputs
from preprocess.poses.pose_file import write_motion
from preprocess.sfm.capture_solving import apply_camera_solution, solve_capture_cameras


def track_missing_poses(
    arguments: IngestArguments, run: RunFolder, console: Console
) -> IngestArguments:
    """Return the arguments with poses and masks that were tracked in the video.

    Unchanged if poses were given, or the source is live. Poses are written to the run's folder
    tracking/, as ia-track writes them. After Ctrl-C that folder holds the frames before it, and a
    resumed run goes on with the next.

    Raises:
        CommandExit: After Ctrl-C.
    """
    inputs = arguments.capture_inputs()
    if arguments.tracks_stream or not needs_tracking(inputs):
        return arguments
    stored = _read_stored(run) if arguments.resume else None
    asked = _describe_request(arguments)
    if stored is not None and stored["request"] != asked:
        stored = None
    if stored is None or not stored["complete"]:
        beside = find_own_poses(arguments.video.parent)
        if beside is not None:
            console.warning(f"{beside} lies beside the video; to use it, pass --poses.")
        with stop_on_interrupt(console, "keeping the frames that were tracked") as stop:
            tracking = _track(inputs, run, console, stop, resume=stored is not None)
        chosen = tracking.inputs.frames
        stored = {
            "request": asked,
            "frames": None if chosen is None else [chosen.start, chosen.stop, chosen.step],
            "masks": tracking.inputs.masks == run.tracking / "masks",
            "grade": tracking.grade.as_json(),
            "complete": not tracking.interrupted,
        }
        write_text_atomically(run.tracking_grade, json.dumps(stored, indent=1) + "\n")
        if stop.is_set():
            raise CommandExit(
                f"stopped by Ctrl-C. {tracking.grade.frames} tracked frames are kept in "
                f"{run.tracking}: to go on from there, run the same command with --resume.",
                INTERRUPTED,
            )
        if tracking.grade.is_good_enough or arguments.force:
            print_grade(tracking.grade, console)
        else:
            _remove_tracking(run)
            look = quote_command("ia-track", arguments.video)
            raise InputError(
                f"{tracking.grade.describe()} Look at the poses ({look}), film the person again, "
                "or give --poses of another tracker. To train anyway, pass --force."
            )
    return _with_stored(arguments, run, stored)


def read_tracked_poses(arguments: IngestArguments, run: RunFolder) -> IngestArguments:
    """Return a finished run's arguments with the poses and masks that were tracked for it."""
    stored = _read_stored(run)
    is_own = stored is not None and stored["request"] == _describe_request(arguments)
    return _with_stored(arguments, run, stored) if stored is not None and is_own else arguments


def _with_stored(
    arguments: IngestArguments, run: RunFolder, stored: dict[str, Any]
) -> IngestArguments:
    frames, text = stored["frames"], arguments.frames
    if frames is not None:
        text = format_frame_range(slice(*frames))
    masks = run.tracking / "masks" if stored["masks"] else arguments.masks
    return replace(arguments, poses=run.tracked_poses, masks=masks, frames=text, person=None)


def remove_unused_tracking(arguments: IngestArguments, run: RunFolder) -> None:
    """Remove what was tracked for an older run in the same folder, unless this run uses it."""
    if arguments.poses != run.tracked_poses and not arguments.resume:
        _remove_tracking(run)


def read_tracking_report(arguments: IngestArguments, run: RunFolder) -> dict[str, Any] | None:
    """Return the grades of the poses that were tracked for a run; None if they were given."""
    stored = _read_stored(run) if arguments.poses == run.tracked_poses else None
    return None if stored is None else stored["grade"]


def _track(
    inputs: CaptureInputs,
    run: RunFolder,
    console: Console,
    stop: threading.Event,
    *,
    resume: bool,
) -> PersonTracking:
    """Track the person into the run's folder; leave no empty folder if that fails."""
    run.tracking.mkdir(parents=True, exist_ok=True)
    OutputFileList(run.tracking).create()
    OutputFileList(run.tracking).remove_temporaries()
    try:
        return track_person(inputs, run.tracked_poses, console, stop=stop, resume=resume)
    finally:
        OutputFileList(run.tracking).remove_if_empty()
        with suppress(OSError):  # not empty
            run.tracking.rmdir()


def _remove_tracking(run: RunFolder) -> None:
    for folder in (run.tracking / "masks", run.tracking):
        OutputFileList(folder).remove_all()
        with suppress(OSError):  # not empty, or missing
            folder.rmdir()


def _describe_request(arguments: IngestArguments) -> dict[str, Any]:
    """Return what decides the tracked poses; those of another request are tracked again."""
    named = {
        name: None if value is None else str(value)
        for name, value in vars(arguments).items()
        if name in ("masks", "cameras", "body", "frames", "person", "tracker", "rotate")
    }
    return {"video": str(arguments.video.resolve()), **named}


def _read_stored(run: RunFolder) -> dict[str, Any] | None:
    """Return what was tracked for the run before; None if that cannot be used."""
    try:
        stored = json.loads(run.tracking_grade.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    expected = {"request", "frames", "masks", "grade", "complete"}
    usable = isinstance(stored, dict) and stored.keys() == expected
    return stored if usable and run.tracked_poses.is_file() else None


def solve_missing_cameras(
    arguments: IngestArguments, capture: Capture, console: Console
) -> Capture:
    """Return the capture in the world of cameras that are solved, if --cameras solve asks for it.

    The given capture has its poses in the camera of each frame.
    """
    if arguments.cameras != "solve":
        return capture
    source = capture.source
    if source.paced:
        source = reopen(source, arguments.capture_inputs().frames)
    with console.progress("solving cameras", 1.0) as bar:
        solved = solve_capture_cameras(
            replace(capture, source=source),
            seed=arguments.seed,
            threads=arguments.threads or os.cpu_count() or 1,
            report_progress=bar.set_share,
        )
    placed = apply_camera_solution(capture, solved)
    console.info(placed.notes[-1])
    return placed


def write_solved_cameras(capture: Capture, run: RunFolder, console: Console) -> None:
    """Write cameras.npz and poses.npz of the run, if its cameras were solved.

    Solving takes minutes: call it before training, so that the result is kept whatever follows.
    The poses are those before the fit to the masks, which `checkpoint/` holds.
    """
    if capture.camera_report is None or capture.camera_report["verdict"] != "solved":
        return
    with atomic_file(run.cameras) as path:
        write_cameras(path, capture.cameras)
    with atomic_file(run.poses) as path:
        write_motion(path, replace(capture.motion, intrinsic=None, camera_from_world=None))
    console.print_artifact("cameras", run.cameras)
    console.print_artifact("poses there", run.poses)

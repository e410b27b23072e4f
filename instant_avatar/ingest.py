"""ia-ingest: train an avatar from a video of one person while the video is being read."""

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from capture.input_error import InputError
from instant_avatar.capture_validation import correction_hint, preflight_check
from instant_avatar.cli.command_line import (
    exit_on_interrupt,
    fill_optional_value,
    parse_arguments,
    require_packages,
    run_command,
)
from instant_avatar.cli.console import Console
from instant_avatar.run.ingest_arguments import PROGRAM, VIEW_PORT, IngestArguments
from instant_avatar.run.missing_inputs import (
    read_tracking_report,
    solve_missing_cameras,
    track_missing_poses,
    write_solved_cameras,
)
from instant_avatar.run.run_folder import RunFolder
from preprocess.capture_session import Capture
from preprocess.fitting.capture_fit import load_capture_fit
from preprocess.fitting.capture_fitting import apply_fit, fit_capture

if TYPE_CHECKING:  # it imports torch
    from instant_avatar.run.session_events import EventReader


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    words = fill_optional_value(sys.argv[1:] if argv is None else argv, "--view", VIEW_PORT)
    arguments = parse_arguments(IngestArguments, PROGRAM, words)
    return run_command(PROGRAM, lambda: ingest(arguments, Console()))


def ingest(
    arguments: IngestArguments, console: Console, readers: Sequence["EventReader"] = ()
) -> int:
    """Open, track, solve cameras, align; then train, bake and report, which `readers` read of.

    After an `InputError` nothing was written; on a full disk the newest checkpoint is kept.
    """
    started_at = time.perf_counter()
    solver = ("pycolmap",) if arguments.cameras == "solve" else ()
    require_packages("torch", "numba", "onnx", *solver)
    arguments.validate()
    run, inputs = arguments.run_folder(), arguments.capture_inputs().input_paths()
    run.check_usable(inputs, resume=arguments.resume, overwrite=arguments.overwrite)
    with run.claim(console, resume=arguments.resume, overwrite=arguments.overwrite):
        command, arguments = arguments.as_json(), track_missing_poses(arguments, run, console)
        threads = None
        if arguments.tracks_stream:  # its frames come as soon as it is open
            threads = _load_trainer_code(arguments, run, console)
        capture = _open_checked(arguments, run, console)
        placed = solve_missing_cameras(arguments, capture, console)
        capture = _fit_to_masks(arguments, placed, run, console)
        threads = threads or _load_trainer_code(arguments, run, console)
        from instant_avatar.report.report_writer import ReportWriter
        from instant_avatar.run.session_start import run_session

        report = ReportWriter(
            capture, run, console, command=command, started_at=started_at, threads=threads,
            copy=None if arguments.json is None else (arguments.json, arguments.may_replace_json),
        )  # fmt: skip
        run_session(
            arguments, capture, run, console, [report, *readers],
            on_start=lambda: write_solved_cameras(placed, run, console),
        )  # fmt: skip
        return report.exit_code()


def _load_trainer_code(arguments: IngestArguments, run: RunFolder, console: Console) -> int:
    """Import torch, and set and return the number of its threads."""
    with exit_on_interrupt(console, PROGRAM, run.release), console.status("loading torch"):
        from instant_avatar.report import report_writer  # noqa: F401
        from instant_avatar.run import training_session  # noqa: F401
        from instant_avatar.run.session_start import set_threads

        return set_threads(arguments.threads)


def _open_checked(arguments: IngestArguments, run: RunFolder, console: Console) -> Capture:
    """Open the capture, and check that poses, masks and cameras agree."""
    try:
        with console.status("opening video and poses"):
            capture = arguments.open_capture()
    except InputError as error:
        hint = correction_hint(arguments.capture_inputs())
        if not hint:
            raise
        raise InputError(f"{error} {hint}") from error
    capture = replace(capture, tracking_report=read_tracking_report(arguments, run))
    console.info(_describe_capture(capture))
    for note in capture.notes:
        console.note(note)
    if not (arguments.resume and run.has_checkpoint()):
        preflight_check(capture, arguments.capture_inputs(), console, force=arguments.force)
    return capture


def _fit_to_masks(
    arguments: IngestArguments, capture: Capture, run: RunFolder, console: Console
) -> Capture:
    """Fit body, poses and focal length to the masks, unless they are exact or were fitted."""
    was_fitted = capture.motion.proportions is not None or capture.live is not None
    if not arguments.refine_poses or was_fitted:
        return capture
    resumes = arguments.resume and run.has_checkpoint()
    fit = load_capture_fit(run.fit_file, capture.identity) if resumes else None
    if fit is None:
        with console.status("fitting body and poses to the masks"):
            fit = fit_capture(capture, fit_body=not resumes)
    if fit is None:
        return capture
    fitted = apply_fit(capture, fit, height_m=arguments.capture_inputs().height_m)
    for note in fitted.notes[len(capture.notes) :]:
        console.note(note)
    if (advice := fit.advice()) is not None:
        console.warning(advice)
    return fitted


def _describe_capture(capture: Capture) -> str:
    source, (width, height) = capture.source, capture.source.size_px
    count = "frames" if source.frame_count is None else f"{source.frame_count} frames"
    return (
        f"{capture.paths.video}: {count} of {width}x{height} px, {len(capture.motion)} poses, "
        f"body {capture.shaped.body.family}, camera: {capture.cameras.source}"
    )


if __name__ == "__main__":
    sys.exit(main())

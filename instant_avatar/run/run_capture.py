"""The capture of a run: read, tracked or streamed, aligned, in the world of its cameras, fitted."""

import os
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import replace

from capture.atomic_files import atomic_file
from capture.input_error import InputError, counted
from capture.source import Frame, FrameSource
from instant_avatar.capture_validation import correction_hint, preflight_check
from instant_avatar.cli.console import Console
from instant_avatar.run.ingest_arguments import IngestArguments
from instant_avatar.run.person_tracking import (
    FitFunction,
    fit_in_process,
    person_number,
    print_first_look,
)
from instant_avatar.run.run_folder import RunFolder
from instant_avatar.run.run_tracking import import_tracked
from preprocess.cameras.camera_file import write_cameras
from preprocess.capture_inputs import CaptureInputs, InputKind
from preprocess.capture_session import (
    Capture,
    CaptureFit,
    ObservationSource,
    RecordedObservations,
    load_capture_fit,
    video_identity,
)
from preprocess.fitting.capture_fitting import apply_fit, fit_capture
from preprocess.masks.mask_refinement import MaskRefiner
from preprocess.open_capture import (
    ImportedCapture,
    align_capture,
    open_tracked_stream,
    read_capture,
)
from preprocess.plugins import DEFAULT_TRACKER, make_tracker
from preprocess.poses.pose_file import write_motion
from preprocess.sfm.camera_solver import apply_camera_solution, solve_capture_cameras
from preprocess.tracking.first_look import look_at
from preprocess.tracking.keypoints import PersonKeypoints


def open_observations(
    arguments: IngestArguments,
    inputs: CaptureInputs,
    run: RunFolder,
    console: Console,
    on_tracked: Callable[[Frame, PersonKeypoints | None], object] = lambda *_: None,
    *,
    fit: FitFunction = fit_in_process,
    background: Executor | None = None,
) -> tuple[ObservationSource, Capture]:
    """Open what a run learns from, whatever the input is.

    Args:
        on_tracked: Receives each frame of a stream that was searched, and the person in it.
        fit: Fits a recording with poses that no run has fitted before, or that were tracked.
        background: Where a first look at a recording with poses is taken, and printed; without it
            none is.

    Returns:
        The observations, and their capture before it was fitted to the masks.
    """
    resumes = arguments.resume and run.has_checkpoint()
    if inputs.kind is InputKind.STREAMED:
        with console.status("opening video and poses"):
            stream = _open_stream(arguments, inputs, run, on_tracked, resumes=resumes)
        _describe(stream.capture, console)
        return stream, stream.capture
    if inputs.kind is InputKind.UNTRACKED:
        imported = import_tracked(arguments, inputs, run, console, fit)
    else:
        imported = read_capture(inputs)
    earlier = None
    is_new = inputs.kind is InputKind.POSED and not resumes  # what was tracked here has its grade
    if is_new and background is not None:
        background.submit(_take_first_look, imported.source, inputs, console)
    with console.status("opening video and poses"):
        size_px = arguments.longer_side_px(imported.source)
        try:
            if resumes:
                capture, earlier = _align_as_trained(imported, run, size_px)
            else:
                capture = align_capture(imported, size_px=size_px)
        except InputError as error:
            hint = correction_hint(imported)
            if not hint:
                raise
            raise InputError(f"{error} {hint}") from error
    _describe(capture, console)
    if is_new:
        preflight_check(capture, imported.inputs, console, force=arguments.force)
    if inputs.cameras == "solve":
        capture = _solve_cameras(arguments, capture, console)
    fitted = capture
    if arguments.refine_poses and not capture.motion.is_fitted:
        if earlier is None:
            earlier = _fit_poses(capture, console) if resumes else fit(capture, console)
        fitted = _apply_fit(capture, earlier, inputs, console)
    return RecordedObservations(fitted, realtime=inputs.realtime), capture


def _fit_poses(capture: Capture, console: Console) -> CaptureFit | None:
    with console.status("fitting poses"):
        return fit_capture(capture, fit_body=False)


def _take_first_look(source: FrameSource, inputs: CaptureInputs, console: Console) -> None:
    with suppress(InputError, OSError, ValueError):  # damaged: reading names it
        print_first_look(look_at(source), inputs, console, tracks=False)


def open_as_trained(imported: ImportedCapture, run: RunFolder, size_px: int) -> Capture:
    """Align a run's own recording with the body and the poses that it was trained with."""
    capture, fit = _align_as_trained(imported, run, size_px)
    return capture if fit is None else apply_fit(capture, fit, height_m=imported.inputs.height_m)


def _align_as_trained(
    imported: ImportedCapture, run: RunFolder, size_px: int
) -> tuple[Capture, CaptureFit | None]:
    """Align a recording with the person of a run; also return the fit of its checkpoint."""
    fit = load_capture_fit(run.fit_file, video_identity(imported.source))
    keeps_person = run.body_file.is_file() and (fit is None or not fit.fits_body)
    person = run.body_file if keeps_person else None
    return align_capture(imported, size_px=size_px, avatar_body=person), fit


def _open_stream(
    arguments: IngestArguments,
    inputs: CaptureInputs,
    run: RunFolder,
    on_tracked: Callable[[Frame, PersonKeypoints | None], object],
    *,
    resumes: bool,
) -> ObservationSource:
    tracker = make_tracker(inputs.tracker or DEFAULT_TRACKER, person_number(inputs.person))
    person = run.body_file if resumes and run.body_file.is_file() else None
    return open_tracked_stream(
        inputs, tracker, MaskRefiner, run.tracked_poses,
        longer_side_px=arguments.longer_side_px, avatar_body=person, on_tracked=on_tracked,
    )  # fmt: skip


def _describe(capture: Capture, console: Console) -> None:
    console.info(
        f"{counted(len(capture.motion), 'pose')}, body {capture.shaped.body.family}, camera: "
        f"{capture.cameras.source}"
    )
    for note in capture.notes:
        console.note(note)


def _solve_cameras(arguments: IngestArguments, capture: Capture, console: Console) -> Capture:
    with console.progress("solving cameras", 1.0) as bar:
        solved = solve_capture_cameras(
            capture,
            seed=arguments.seed,
            threads=arguments.threads or os.cpu_count() or 1,
            report_progress=bar.set_share,
        )
    placed = apply_camera_solution(capture, solved)
    console.info(placed.notes[-1])
    return placed


def _apply_fit(
    capture: Capture, fit: CaptureFit | None, inputs: CaptureInputs, console: Console
) -> Capture:
    if fit is None:
        return capture
    fitted = apply_fit(capture, fit, height_m=inputs.height_m)
    for note in fitted.notes[len(capture.notes) :]:
        console.note(note)
    return fitted


def write_solved_cameras(capture: Capture, run: RunFolder, console: Console) -> None:
    """Write cameras.npz and poses.npz of the run, if its cameras were solved.

    Solving takes minutes: call it before training, so that the result is kept whatever follows.
    The poses are those before the fit to the masks, which `checkpoint/` holds.
    """
    report = capture.figures("cameras")
    if report is None or report["verdict"] != "solved":
        return
    with atomic_file(run.cameras) as path:
        write_cameras(path, capture.cameras)
    with atomic_file(run.poses) as path:
        write_motion(path, replace(capture.motion, intrinsic=None, camera_from_world=None))
    console.print_artifact("cameras", run.cameras)
    console.print_artifact("poses there", run.poses)

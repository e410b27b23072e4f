"""What a run's capture lacks: poses and masks tracked in its video, and cameras solved from it.

A video without poses is tracked first; a resumed run reads its own tracking. Cameras are solved
before training, or beside it, and written next to the avatar. An avatar is trained from poses in
the camera of each frame; where that camera stood matters only to the world around it. With a stated
K and given masks training therefore does not wait. Without K the focal length has to be solved
first; without masks the segmenter must know how the camera moves.
"""

import json
import shlex
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any, final

from apps.cli.command_line import INTERRUPTED, CommandExit, stop_on_interrupt
from apps.cli.console import Console
from apps.cli.shared_options import format_frame_range
from apps.run.ingest_arguments import IngestArguments
from apps.run.person_tracking import PersonTracking, needs_tracking, print_grade, track_person
from apps.run.run_folder import RunFolder
from apps.run.solver_process import SolveJob, SolverProcess
from capture.atomic_files import OutputFileList, atomic_file, write_text_atomically
from capture.camera import Camera
from capture.input_error import InputError
from preprocess.cameras.camera_file import ASSUMED_CAMERA_SOURCE, write_cameras
from preprocess.capture_paths import find_own_poses
from preprocess.capture_session import Capture, CaptureInputs
from preprocess.poses.pose_file import write_motion
from preprocess.sfm.camera_solution import CameraSolution
from preprocess.sfm.metric_world import MetricPlacement, place_in_metric_world, solution_report


def track_missing_poses(
    arguments: IngestArguments, run: RunFolder, console: Console
) -> IngestArguments:
    """Return the arguments with poses and masks that were tracked in the video.

    Unchanged if poses were given, or the source is live. Poses are written to the run's folder
    tracking/, as ia-track writes them. After Ctrl-C that folder holds the frames before it, and a
    resumed run goes on with the next.

    Raises:
        CommandExit: After Ctrl-C.
        InputError: If the video cannot be read, or no person is found in it.
        OSError: If the disk is full.
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
            look = shlex.join(["ia-track", str(arguments.video)])
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
    """Remove tracked poses and masks."""
    for folder in (run.tracking / "masks", run.tracking):
        OutputFileList(folder).remove_all()
        with suppress(OSError):  # not empty, or missing
            folder.rmdir()


def _describe_request(arguments: IngestArguments) -> dict[str, Any]:
    """What decides the tracked poses; poses of another request are tracked again."""
    named = {
        name: None if value is None else str(value)
        for name, value in vars(arguments).items()
        if name in ("masks", "cameras", "body", "frames", "person", "tracker")
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


def apply_camera_solution(recording: Capture, solved: CameraSolution) -> Capture:
    """Return the capture in the world of its solved cameras; unchanged if the camera stood still.

    Args:
        recording: With poses in the camera of each frame.
        solved: What the pictures say.

    Raises:
        InputError: If nothing tells the size of the world.
    """
    if solved.is_static:
        note = (
            "The camera stood still (the background moved by "
            f"{solved.background_motion:.2%} of the picture), so there was nothing to solve."
        )
        return replace(
            recording,
            notes=(*recording.notes, note),
            camera_report=solution_report(solved, None, recording.source),
        )
    place = place_in_metric_world(
        solved, recording.motion, _tracker_camera(recording), recording.shaped, recording.source
    )
    found = solution_report(solved, place, recording.source)
    return replace(
        recording,
        cameras=place.cameras,
        motion=place.motion,
        camera_report=found,
        notes=(*recording.notes, _describe_solution(found, place)),
    )


def write_solved_capture(recording: Capture, run: RunFolder) -> None:
    """Write cameras.npz and poses.npz of the run, which can be played or reused."""
    with atomic_file(run.cameras) as path:
        write_cameras(path, recording.cameras)
    with atomic_file(run.poses) as path:
        write_motion(path, replace(recording.motion, intrinsic=None, camera_from_world=None))


def _tracker_camera(recording: Capture) -> Camera | None:
    """Return the camera that the poses were made for; None if its focal length was only assumed."""
    motion, camera = recording.motion, recording.cameras[0]
    stated = motion.intrinsic is not None or motion.assumed_focal is not None
    return camera if stated or recording.cameras.source != ASSUMED_CAMERA_SOURCE else None


def _describe_solution(found: dict[str, Any], place: MetricPlacement) -> str:
    frames, scale = found["frames"], found["scale"]
    several = f"{frames['interpolated']} interpolated, " if frames["interpolated"] else ""
    return (
        f"Cameras: {frames['key']} key frames solved, {frames['placed']} placed between them, "
        f"{several}{frames['missing']} missing; focal length {found['focal_px']:.0f} px; size by "
        f"{' and '.join(scale['cues'])}, {place.floor_points} points of the floor seen."
    )


MAX_FOCAL_DIFFERENCE = 0.02
"""Relative difference between the stated and the solved focal length that is worth a warning."""


@final
class CameraSolving:
    """The cameras of one run, while they are being solved.

    Attributes:
        beside: Whether training runs at the same time.
        refused: Why there are no cameras, if the run was trained without them.
    """

    def __init__(self, solving: SolverProcess | None, *, beside: bool) -> None:
        """Take over a process that has begun; None where nothing is to be solved."""
        self._solving, self.beside = solving, beside
        self.refused: str | None = None
        self._asked = False

    def wait_before_training(self, recording: Capture, console: Console) -> Capture:
        """Return what the run is trained on: in its solved world, if training had to wait for it.

        Raises:
            InputError: If the cameras cannot be solved with certainty.
        """
        if self.beside or self._solving is None:
            return recording
        try:
            solved = self._solving.wait(console)
            assert solved is not None  # there is no event that could stop it here
            found = apply_camera_solution(recording, solved)
        except KeyboardInterrupt as error:
            error.add_note("Stages of the cameras that were finished are kept: the same command "
                           "goes on from there.")  # fmt: skip
            raise
        _print_new_notes(recording, found, console)
        return found

    def wait_after_training(
        self, recording: Capture, run: RunFolder, console: Console, stop: threading.Event
    ) -> Capture:
        """Return and write what the report is about, after training beside the solver.

        Refused cameras do not stop the run: the avatar is finished already.

        Raises:
            OSError: If the cameras cannot be written.
        """
        if not self.beside or self._solving is None:
            return recording
        self._asked = True
        try:
            solved = self._solving.wait(console, stop)
            if solved is None:
                return replace(recording, camera_report={"verdict": "stopped"})
            found = apply_camera_solution(recording, solved)
        except InputError as refusal:
            self.refused = str(refusal)
            return replace(recording, camera_report={"verdict": "refused", "reason": str(refusal)})
        _print_new_notes(recording, found, console)
        self._write(found, run, console)
        stated, true = recording.cameras[0].focal_px[0], found.cameras[0].focal_px[0]
        if found.camera_report is not None and abs(true / stated - 1.0) > MAX_FOCAL_DIFFERENCE:
            console.warning(
                f"The poses state a focal length of {stated:.0f} px, the pictures one of "
                f"{true:.0f} px; the avatar was learnt with the former. Leave K out of the poses, "
                "and it is learnt with the latter."
            )
        return found

    @contextmanager
    def save_on_exit(self, recording: Capture, run: RunFolder, console: Console) -> Iterator[None]:
        """Write the cameras solved so far and, if the block fails, those solved since.

        Solving takes minutes: its result is kept whatever happens to the avatar.

        Args:
            recording: The capture that `wait_before_training` returned.
            run: The run, which has begun.
            console: Prints the paths of the files.

        Raises:
            OSError: If cameras that were solved before the block cannot be written.
        """
        self._write(recording, run, console)
        try:
            yield
        except BaseException:
            if self.beside and not self._asked:
                with suppress(InputError, OSError):  # report what ended the block instead
                    at_once = threading.Event()
                    at_once.set()
                    self.wait_after_training(recording, run, console, at_once)
            raise

    def _write(self, recording: Capture, run: RunFolder, console: Console) -> None:
        if recording.camera_report is None or recording.camera_report["verdict"] != "solved":
            return
        write_solved_capture(recording, run)
        console.print_artifact("cameras", run.cameras)
        console.print_artifact("poses there", run.poses)


@contextmanager
def start_camera_solving(
    job: SolveJob | None, recording: Capture, run: RunFolder
) -> Iterator[CameraSolving]:
    """Start solving, if there is a job; it does not outlive the block.

    Args:
        job: What is to be solved, if anything.
        recording: The opened capture of that job.
        run: Keeps the stages.

    Raises:
        InputError: If pycolmap is missing.
    """
    if job is None:
        yield CameraSolving(None, beside=False)
        return
    beside = recording.motion.intrinsic is not None and recording.segment is None
    with SolverProcess(job, run.path, gently=beside) as solving:
        yield CameraSolving(solving, beside=beside)


def _print_new_notes(before: Capture, after: Capture, console: Console) -> None:
    for note in after.notes[len(before.notes) :]:
        console.info(note)

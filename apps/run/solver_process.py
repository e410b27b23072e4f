"""Solve a capture's cameras in a process of its own, beside whatever else the run does.

The process works in a folder that belongs to exactly one job: stages that are finished stay there,
and the same job takes them up again. It sends its progress through a pipe, and never outlives the
process that started it.
"""

import hashlib
import json
import multiprocessing
import os
import queue
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import NamedTuple, final

import cv2
import numpy as np
from jaxtyping import Bool

from apps.cli.console import Console
from capture.input_error import InputError
from capture.source import Frame
from preprocess.body.body_surface import MeshSilhouette
from preprocess.capture_session import Capture, CaptureInputs
from preprocess.observation import alpha_channel_mask, associate_masks, associate_poses
from preprocess.open_capture import open_capture
from preprocess.sfm.camera_solution import CameraSolution
from preprocess.sfm.camera_solver import STAGES_FILE, SolverSettings, StageProgressFn, solve_cameras
from preprocess.sfm.colmap_mapping import PersonMaskFn, require_pycolmap

METHOD_VERSION = 4
"""Version of the solver and of its files; stages of another version are not taken up."""

BODY_MARGIN = 0.06
"""Margin for clothes and hair around the posed body; a fraction of its height in the image."""

MASK_THRESHOLD = 0.2
"""Opacity from which a pixel of a mask counts as the person."""

SOLUTION_FILE = "solved.json"
"""Written last: the solution is complete where it exists."""

LOG_FILE = "log.txt"
"""Everything that the process and its libraries print."""

KEPT_FILES = frozenset({SOLUTION_FILE, "solved.npz", "model.npz", STAGES_FILE, LOG_FILE})
"""Files of a job's folder that stay once it is solved."""

STAGE_TIME_FRACTIONS = {
    "key frames": 0.05, "features": 0.4, "matches": 0.1, "global mapping": 0.25,
    "incremental mapping": 0.15, "frames between": 0.05,
}  # fmt: skip
"""Usual fraction of the whole time that each stage takes, for the progress bar."""

REPORT_INTERVAL_S = 0.2
"""Shortest time between two reports of one stage's progress, seconds."""

POLL_INTERVAL_S = 0.2
"""Longest delay before a request to stop is noticed, seconds."""

TERMINATE_TIMEOUT_S = 5.0
"""Time that the process has to end after SIGTERM before it is killed, seconds."""


@dataclass(frozen=True, kw_only=True)
class SolveJob:
    """A capture and what its solution depends on.

    Attributes:
        paths: What the user named.
        seed: Seed of everything random.
        threads: Threads for features and matches; the result does not depend on it.
    """

    paths: CaptureInputs
    seed: int
    threads: int

    def folder(self, run: Path) -> Path:
        """Folder for the stages of this very job; other files or options have another one."""
        return run / "cameras" / self.key()

    def key(self) -> str:
        """Hash of the options, and of the files' names, sizes and times."""
        job = self.with_absolute_paths()
        named = (job.paths.video, job.paths.poses, job.paths.masks, job.paths.body)
        states = [_file_state(path) for path in named if path is not None]
        options = {name: str(value) for name, value in asdict(job.paths).items()}
        text = json.dumps([METHOD_VERSION, options, self.seed, states], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def with_absolute_paths(self) -> "SolveJob":
        """The job for a process that works in another folder."""
        paths = {
            name: path.resolve()
            for name in ("video", "poses", "masks", "body")
            if (path := getattr(self.paths, name)) is not None and path.exists()
        }  # what does not exist is the name of a segmenter
        return replace(self, paths=replace(self.paths, **paths))


def _file_state(path: Path) -> list[tuple[str, int, int]]:
    """Name, size and time of a file, or of each file in a folder; empty if there is none."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path] if path.exists() else []
    return [(str(file), (stat := file.stat()).st_size, stat.st_mtime_ns) for file in files]


class StageProgress(NamedTuple):
    """How far a stage of the solution has come; `fraction` is within [0, 1]."""

    stage: str
    fraction: float


@final
class SolverProcess:
    """A solution in the making, or one that was made before."""

    def __init__(self, job: SolveJob, run: Path, *, gently: bool = False) -> None:
        """Starts the process, unless the very same job was finished before.

        Args:
            job: What is to be solved.
            run: Folder of the run.
            gently: Lowers the priority of the process.

        Raises:
            InputError: If pycolmap is missing.
        """
        job = job.with_absolute_paths()
        self.folder = job.folder(run).resolve()
        self._process: BaseProcess | None = None
        self._messages: queue.Queue[StageProgress | InputError | None] = queue.Queue()
        if (self.folder / SOLUTION_FILE).exists():
            return
        require_pycolmap()
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / LOG_FILE).write_text("", encoding="utf-8")
        spawn = multiprocessing.get_context("spawn")
        receiver, sender = spawn.Pipe(duplex=False)
        process = spawn.Process(target=_run, args=(job, self.folder, gently, sender), daemon=True)
        with _environment_of_child(job.threads):
            process.start()
        self._process = process
        sender.close()  # the child's copy is the only one: its end is the end of the messages
        threading.Thread(target=self._listen, args=(receiver,), daemon=True).start()

    @property
    def running(self) -> bool:
        """Whether it still works."""
        return self._process is not None and self._process.is_alive()

    def wait(self, console: Console, stop: threading.Event | None = None) -> CameraSolution | None:
        """Waits for the solution, with a progress bar; None if it was stopped before.

        Args:
            console: Where the bar is.
            stop: Ends the waiting once it is set; a solution that is there counts all the same,
                and stages that are finished stay.

        Raises:
            InputError: If the cameras cannot be solved with certainty.
        """
        if self._process is None:
            return CameraSolution.load(self.folder)
        began, done = time.perf_counter(), dict.fromkeys(STAGE_TIME_FRACTIONS, 0.0)
        with console.progress("solving cameras", 1.0) as bar:
            while True:
                if stop is not None and stop.is_set() and self.running:
                    self.stop()
                    return None
                try:
                    message = self._messages.get(timeout=POLL_INTERVAL_S)
                except queue.Empty:
                    continue
                if message is None:
                    break
                if isinstance(message, InputError):
                    raise message
                _advance_stages(done, message)
                share = sum(STAGE_TIME_FRACTIONS[name] * part for name, part in done.items())
                seconds = time.perf_counter() - began
                bar.update(share, _progress_note(message.stage, share, seconds))
        self._process.join()
        self._check(self._process.exitcode)
        self._tidy()
        return CameraSolution.load(self.folder)

    def stop(self) -> None:
        """Ends the process; what it has finished stays for the next time."""
        if self._process is None:
            return
        self._process.terminate()
        self._process.join(TERMINATE_TIMEOUT_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def __enter__(self) -> "SolverProcess":
        """Stopped at the end of the block, however it ends."""
        return self

    def __exit__(self, *_: object) -> None:
        """Ends the process, if it still runs."""
        self.stop()

    def _listen(self, receiver: Connection) -> None:
        """Empty the pipe all the time, so that the process never blocks on a full one."""
        with receiver, suppress(EOFError, OSError):
            while True:
                self._messages.put(receiver.recv())
        self._messages.put(None)

    def _check(self, code: int | None) -> None:
        """Raises unless the process has done its work."""
        if code == 0:
            return
        printed = (self.folder / LOG_FILE).read_text(encoding="utf-8").strip().splitlines()
        raise InputError(
            f"The solving of cameras ended with {code}{': ' + printed[-1] if printed else ''}. Its "
            f"log: {self.folder / LOG_FILE}. What was finished is kept: try again, or give "
            "--cameras FILE (docs/formats.md)."
        )

    def _tidy(self) -> None:
        """Removes the results of stages that only later stages needed."""
        notes = self.folder / STAGES_FILE
        stages = json.loads(notes.read_text(encoding="utf-8")) if notes.exists() else {}
        for path in (self.folder / name for name in stages):
            if path.name not in KEPT_FILES:
                shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def _advance_stages(done: dict[str, float], progress: StageProgress) -> None:
    """Updates how much of each stage is done; all stages before the reported one are finished."""
    names = list(STAGE_TIME_FRACTIONS)
    name = next((n for n in names if progress.stage.startswith(n)), None)
    if name is None:
        return
    for before in names[: names.index(name)]:
        done[before] = 1.0
    done[name] = max(done[name], progress.fraction)


def _progress_note(stage: str, share: float, seconds: float) -> str:
    left = "" if share < 0.08 else f" · about {seconds * (1.0 - share) / share:.0f} s left"
    return f"{stage.rstrip(' 0123456789')} · {100.0 * share:.0f} %{left}"


@contextmanager
def _environment_of_child(threads: int) -> Iterator[None]:
    """What a process inherits that starts in this block: its threads, and to ignore Ctrl-C.

    SIGINT is blocked, which a child inherits: Ctrl-C reaches all processes of a terminal, but only
    the parent is to act on it. multiprocessing's own helper would unblock it, unless it runs.
    """
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    resource_tracker.ensure_running()
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.environ.update(dict.fromkeys(names, str(threads)))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


# --- in the process ------------------------------------------------------------------------------


def _run(job: SolveJob, folder: Path, gently: bool, sender: Connection) -> None:
    """Solves a job, and sends its progress, or why it cannot be solved."""
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    with (folder / LOG_FILE).open("a", encoding="utf-8") as log:
        for stream in (1, 2):  # of C++ libraries, too
            os.dup2(log.fileno(), stream)
    if gently:
        os.nice(10)
    try:
        run_job(job, folder, _throttled(sender))
    except InputError as refusal:
        sender.send(refusal)


def _exit_with_parent() -> None:
    """Ends this process when its parent is gone, even killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(130)


def _throttled(sender: Connection) -> StageProgressFn:
    """Sends progress, at most once in `REPORT_INTERVAL_S` unless a stage begins or ends."""
    sent_at, sent_stage = 0.0, ""

    def report(stage: str, fraction: float) -> None:
        nonlocal sent_at, sent_stage
        now = time.monotonic()
        if stage != sent_stage or fraction >= 1.0 or now - sent_at >= REPORT_INTERVAL_S:
            sent_at, sent_stage = now, stage
            sender.send(StageProgress(stage, fraction))

    return report


def run_job(job: SolveJob, folder: Path, report_progress: StageProgressFn) -> None:
    """Solves a capture's cameras into a folder; takes up what lies there.

    Raises:
        InputError: If they cannot be solved with certainty.
    """
    cv2.setNumThreads(job.threads)
    recording = open_capture(job.paths, skip_checks=True)
    intrinsic, longer = recording.cameras[0].intrinsic, max(recording.source.size_px)
    known = recording.motion.intrinsic is not None
    settings = SolverSettings(
        focal_ratio=float(intrinsic[0, 0]) / longer if known else None,
        seed=job.seed,
        threads=job.threads,
    )
    person = make_person_mask(recording)
    solve_cameras(recording.source, person, folder, settings, report_progress).save(folder)


def make_person_mask(recording: Capture) -> PersonMaskFn:
    """Where the person is: by the masks, or by the posed body with room for clothes."""
    source = recording.source
    if recording.masks is not None or source.has_alpha:
        row_of = associate_masks(recording.masks, source)

        def by_mask(frame: Frame, size_px: tuple[int, int]) -> Bool[np.ndarray, "_ _"] | None:
            try:
                if recording.masks is None:
                    return alpha_channel_mask(frame, size_px) > MASK_THRESHOLD
                return recording.masks.alpha(row_of(frame.index), size_px) > MASK_THRESHOLD
            except InputError:  # one damaged mask
                return None

        return by_mask
    outline, pose_row = MeshSilhouette(recording.shaped), associate_poses(recording.motion, source)

    def by_body(frame: Frame, size_px: tuple[int, int]) -> Bool[np.ndarray, "_ _"] | None:
        row = pose_row(frame)
        if row is None or not recording.motion.valid[row]:
            return None
        body = outline.draw_pose(recording.motion[row], recording.cameras[0].resize(size_px))
        rows = np.flatnonzero(body.any(axis=1))
        if not len(rows):
            return None
        side = 2 * max(2, round(BODY_MARGIN * (rows[-1] - rows[0]))) + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
        return cv2.dilate(body.astype(np.uint8), disc) > 0

    return by_body

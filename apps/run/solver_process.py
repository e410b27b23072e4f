"""What the solving process is to do, and the folder that belongs to exactly that.

The solving process: `python -m apps.run.solver_process FOLDER`, with job.json in the folder.

It writes a line of JSON to stdout whenever it has come further, and ends when its stdin is closed:
so it never outlives who started it.

The solving process as its parent sees it: started, watched, waited for, stopped.
"""

import hashlib
import json
import os
import queue
import shutil
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, final

import cv2
import numpy as np
from jaxtyping import Bool

from apps.cli.console import Console
from capture.frame import Frame
from capture.input_error import InputError
from preprocess.body.silhouette import MeshSilhouette
from preprocess.capture_session import Capture, CaptureInputs
from preprocess.observe import alpha_channel_mask, associate_masks, associate_poses
from preprocess.open_capture import open_capture
from preprocess.sfm.camera_solution import CameraSolution
from preprocess.sfm.camera_solver import SolverSettings, solve_cameras
from preprocess.sfm.colmap_mapping import require_pycolmap
from preprocess.sfm.sfm_keyframes import PersonMaskFn
from preprocess.sfm.stage_cache import STAGES_FILE, StageProgressFn

METHOD_VERSION = 3
"""Of the method: other numbers would come out of the same pictures."""


@dataclass(frozen=True, kw_only=True)
class SolveJob:
    """A capture and what its solution depends on.

    Attributes:
        paths: What the user named.
        seed: Of everything random.
        threads: Of features and matches; the result does not depend on it.
    """

    paths: CaptureInputs
    seed: int
    threads: int

    def folder(self, run: Path) -> Path:
        """Where this very job's stages lie; other files or options have another place."""
        return run / "cameras" / self.key()

    def key(self) -> str:
        """A hash of the options, and of the files' names, sizes and times."""
        content = self.as_json()
        content.pop("threads")
        files = [self.paths.video, self.paths.poses, self.paths.masks, self.paths.body]
        state = [_file_state(path) for path in files if path is not None]
        text = json.dumps([METHOD_VERSION, content, state], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def as_json(self) -> dict[str, Any]:
        """As JSON."""
        paths = asdict(self.paths)
        frames = self.paths.frames
        paths["frames"] = None if frames is None else [frames.start, frames.stop, frames.step]
        for name in ("video", "poses", "masks", "body"):
            if paths[name] is not None:
                paths[name] = str(paths[name])
        return {"paths": paths, "seed": self.seed, "threads": self.threads}

    @classmethod
    def of(cls, content: dict[str, Any]) -> "SolveJob":
        """From what `content` gave."""
        paths = dict(content["paths"])
        frames = paths["frames"]
        paths["frames"] = None if frames is None else slice(*frames)
        for name in ("video", "poses", "masks", "body"):
            if paths[name] is not None:
                paths[name] = Path(paths[name])
        return cls(paths=CaptureInputs(**paths), seed=content["seed"], threads=content["threads"])

    def absolute(self) -> "SolveJob":
        """The same for a process that runs in another folder."""
        named = self.paths
        masks = named.masks
        if masks is not None and masks.exists():  # else the name of a segmenter
            masks = masks.resolve()
        return replace(
            self,
            paths=replace(
                named,
                video=named.video.resolve(),
                poses=None if named.poses is None else named.poses.resolve(),
                masks=masks,
                body=None if named.body is None else named.body.resolve(),
            ),
        )


def _file_state(path: Path) -> list[Any]:
    """By which a changed file or folder is known."""
    if not path.exists():
        return [str(path)]
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    listed = [(str(file), (stat := file.stat()).st_size, stat.st_mtime_ns) for file in files]
    return [hashlib.sha256(repr(listed).encode()).hexdigest()]


EXIT_REFUSED = 2
REPORT_INTERVAL_S = 0.2
BODY_MARGIN = 0.06
"""How far clothes and hair may stick out of the body, in the person's height in the picture."""
SOLUTION_FILE = "solved.json"
KEPT_FILES = frozenset(
    {"job.json", SOLUTION_FILE, "solved.npz", "model.npz", "stages.json", "log.txt"}
)


def main() -> int:
    """The process; returns its exit code."""
    folder = Path(sys.argv[1])
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    job = SolveJob.of(json.loads((folder / "job.json").read_text(encoding="utf-8")))
    try:
        run_job(job, folder, _ProgressPrinter())
    except InputError as refusal:
        (folder / "refused.txt").write_text(str(refusal), encoding="utf-8")
        return EXIT_REFUSED
    return 0


def run_job(job: SolveJob, folder: Path, told: StageProgressFn) -> CameraSolution:
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
    solved = solve_cameras(recording.source, make_person_mask(recording), folder, settings, told)
    solved.save(folder)
    return solved


def make_person_mask(recording: Capture) -> PersonMaskFn:
    """Where the person is: by the masks, or by the posed body with room for clothes."""
    source = recording.source
    if recording.masks is not None or source.has_alpha:
        row_of = associate_masks(recording.masks, source)

        def by_mask(frame: Frame, size_px: tuple[int, int]) -> Bool[np.ndarray, "_ _"] | None:
            try:
                if recording.masks is None:
                    return alpha_channel_mask(frame, size_px) > 0.2
                return recording.masks.alpha(row_of(frame.index), size_px) > 0.2
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


class _ProgressPrinter:
    """Tells stdout, not too often."""

    def __init__(self) -> None:
        self._at, self._stage = 0.0, ""

    def __call__(self, stage: str, share: float) -> None:
        now = time.monotonic()
        if stage == self._stage and share < 1.0 and now - self._at < REPORT_INTERVAL_S:
            return
        self._at, self._stage = now, stage
        print(json.dumps({"stage": stage, "share": share}), flush=True)  # noqa: T201 - read by the parent process


def _exit_with_parent() -> None:
    while os.read(0, 1):  # not sys.stdin, whose lock a thread must not hold at the end
        pass
    os._exit(130)


if __name__ == "__main__":
    sys.exit(main())


STAGE_TIME_FRACTIONS = {
    "key frames": 0.05, "features": 0.4, "matches": 0.1, "global mapping": 0.25,
    "incremental mapping": 0.15, "frames between": 0.05,
}  # fmt: skip
"""Of the whole time, as a rule."""
TERMINATE_TIMEOUT_S = 5.0
POLL_INTERVAL_S = 0.2


@final
class SolverProcess:
    """A solution in the making, or one that was made before."""

    def __init__(self, job: SolveJob, run: Path, *, gently: bool = False) -> None:
        """Starts the process, unless the very same job was finished before.

        Args:
            job: What is to be solved.
            run: Folder of the run.
            gently: Whether somebody else needs the machine more.

        Raises:
            InputError: If pycolmap is missing.
        """
        job = job.absolute()
        self.folder = job.folder(run)
        self._process: subprocess.Popen[str] | None = None
        self._lines: queue.Queue[str | None] = queue.Queue()
        if (self.folder / SOLUTION_FILE).exists():
            return
        require_pycolmap()
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / "refused.txt").unlink(missing_ok=True)
        (self.folder / "job.json").write_text(json.dumps(job.as_json()), encoding="utf-8")
        threads = str(job.threads)
        environment = {**os.environ, "OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads}
        nice = ["nice", "-n", "10"] if gently and shutil.which("nice") else []
        with (self.folder / "log.txt").open("w", encoding="utf-8") as log:
            self._process = subprocess.Popen(
                [*nice, sys.executable, "-m", "apps.run.solver_process", str(self.folder.resolve())],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True,
                env=environment, start_new_session=True,  # Ctrl-C is for us, who then stop it
            )  # fmt: skip
        threading.Thread(target=self._listen, args=(self._process,), daemon=True).start()

    @property
    def running(self) -> bool:
        """Whether it still works."""
        return self._process is not None and self._process.poll() is None

    def wait(self, console: Console, stop: threading.Event | None = None) -> CameraSolution | None:
        """The solution, with a bar until it is there; None if it was stopped before.

        Args:
            console: Where the bar is.
            stop: Set by who does not want to wait any longer; a solution that is there counts all
                the same, and stages that are finished stay.

        Raises:
            InputError: If the cameras cannot be solved with certainty.
        """
        if self._process is not None:
            began, done = time.perf_counter(), dict.fromkeys(STAGE_TIME_FRACTIONS, 0.0)
            with console.progress("solving cameras", 1.0) as bar:
                while (line := self._next_line(stop)) is not None:
                    if not line:
                        self.stop()
                        return None
                    told = json.loads(line)
                    _advance_stages(done, told["stage"], told["share"])
                    share = sum(STAGE_TIME_FRACTIONS[name] * part for name, part in done.items())
                    bar.update(
                        share, _progress_note(told["stage"], share, time.perf_counter() - began)
                    )
            self._check(self._process.wait())
            self._tidy()
        return CameraSolution.load(self.folder)

    def _next_line(self, stop: threading.Event | None) -> str | None:
        """What the process says; None at its end, and nothing if it is to be stopped."""
        while True:
            if stop is not None and stop.is_set() and self.running:
                return ""
            try:
                return self._lines.get(timeout=POLL_INTERVAL_S)
            except queue.Empty:
                continue

    def stop(self) -> None:
        """Ends the process; what it has finished stays for the next time."""
        process = self._process
        if process is None:
            return
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(TERMINATE_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()

    def __enter__(self) -> "SolverProcess":
        """Stopped at the end of the block, however it ends."""
        return self

    def __exit__(self, *_: object) -> None:
        """Ends the process, if it still runs."""
        self.stop()

    def _listen(self, process: "subprocess.Popen[str]") -> None:
        assert process.stdout is not None
        with suppress(ValueError):  # closed by `stop`
            for line in process.stdout:
                if line.startswith("{"):
                    self._lines.put(line)
        self._lines.put(None)

    def _check(self, code: int) -> None:
        """Raises unless the process has done its work."""
        if code == 0:
            return
        refused = self.folder / "refused.txt"
        if code == EXIT_REFUSED and refused.exists():
            raise InputError(refused.read_text(encoding="utf-8"))
        said = (self.folder / "log.txt").read_text(encoding="utf-8").strip().splitlines()
        raise InputError(
            f"The solving of cameras ended with {code}{': ' + said[-1] if said else ''}. Its log: "
            f"{self.folder / 'log.txt'}. What was finished is kept: try again, or give --cameras "
            "FILE (docs/formats.md)."
        )

    def _tidy(self) -> None:
        """Removes the results of stages, which only the way there needed."""
        notes = self.folder / STAGES_FILE
        stages = json.loads(notes.read_text(encoding="utf-8")) if notes.exists() else {}
        for path in (self.folder / name for name in stages):
            if path.name not in KEPT_FILES:
                shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def _advance_stages(done: dict[str, float], stage: str, share: float) -> None:
    """What is done of each stage; a later one says that those before are done, too."""
    names = list(STAGE_TIME_FRACTIONS)
    name = next((n for n in names if stage.startswith(n)), None)
    if name is None:
        return
    for before in names[: names.index(name)]:
        done[before] = 1.0
    done[name] = max(done[name], share)


def _progress_note(stage: str, share: float, seconds: float) -> str:
    left = "" if share < 0.08 else f" · about {seconds * (1.0 - share) / share:.0f} s left"
    return f"{stage.rstrip(' 0123456789')} · {100.0 * share:.0f} %{left}"

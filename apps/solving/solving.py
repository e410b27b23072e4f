"""The solving process as its parent sees it: started, watched, waited for, stopped."""

import json
import os
import queue
import shutil
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import final

from apps.solving.job import SolveJob
from apps.solving.worker import KEPT_FILES, EXIT_REFUSED, SOLUTION_FILE
from apps.terminal.console import Console
from capture.errors import InputError
from preprocess.solve.mapping import require_pycolmap
from preprocess.solve.solved import CameraSolution
from preprocess.solve.stages import STAGES_FILE

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
        (self.folder / "job.json").write_text_atomically(json.dumps(job.as_json()), encoding="utf-8")
        threads = str(job.threads)
        environment = {**os.environ, "OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads}
        nice = ["nice", "-n", "10"] if gently and shutil.which("nice") else []
        with (self.folder / "log.txt").open("w", encoding="utf-8") as log:
            self._process = subprocess.Popen(
                [*nice, sys.executable, "-m", "apps.solving.worker", str(self.folder.resolve())],
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
                    bar.update(share, _progress_note(told["stage"], share, time.perf_counter() - began))
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

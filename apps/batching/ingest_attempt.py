"""One attempt to learn one capture: an ia-ingest process, its limits, and what is left of it."""

import base64
import ctypes
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from apps.batching.remote_files import fetch_inputs, send_files, work_folder
from apps.cli.command_line import BAD_INPUT, DONE
from apps.cli.hardware import describe_machine, total_memory_mb, tree_memory_mb
from capture.input_error import InputError

ROOT = Path(__file__).resolve().parents[2]
"""Where this package lies: the process runs the same code, in whatever folder."""
LOG_NAME = "ingest.log"
"""What ia-ingest printed."""
TURNING_NAME = "turning.webp"
"""The animation of report.html as a file, for the summary."""
PACKAGE_NAME = "avatar.iavatar"
"""The avatar; it is sent last."""
FAILED_NAME = "_failed"
"""Folder in --out with the logs of captures without an avatar."""
KEPT_FILES = (
    LOG_NAME, TURNING_NAME, "report.json", "report.html", "cameras.npz", "poses.npz",
    "tracking/poses.npz", "tracking/grade.json", PACKAGE_NAME,
)  # fmt: skip
"""Files of a run that are brought back."""
ANIMATION = re.compile(r'class="novel"><img src="data:image/webp;base64,([^"]+)"')
"""The animation in report.html."""
POLL_S = 0.1
"""Interval at which the process is looked at, seconds."""
WATCH_S = 0.5
"""Interval at which its memory and its log are looked at, seconds."""
MEMORY_SHARE = 0.5
"""Fraction of the machine's memory that one attempt may take if --memory does not say."""
LOG_TAIL_BYTES = 4096
"""End of the log that is searched for the progress and for the cause of a failure."""
OOM_SCORE = 800
"""Linux kills attempts first where memory runs out, before the batch that supervises them."""


@dataclass(frozen=True, kw_only=True)
class IngestJob:
    """A capture to learn, with what it may use.

    Attributes:
        name: Name of the capture, and of its folder in --out.
        video: Path or URL of the capture.
        options: Options of ia-ingest by field name.
        sources: Files to fetch first: URL, then size in bytes; empty for local captures.
        cores: Cores to ask for, and the threads of numerical libraries.
        gpus: GPUs to ask for.
        memory_mb: Memory to ask for, MB.
        limit_mb: Memory that may be taken, MB; None for half of the machine's.
        limit_s: Time that an attempt may take, seconds; None for any.
        scratch: Folder on the node's own disk.
        disk_bytes: Bytes that all attempts on a node may have fetched at a time; None for any.
        checkpoint: Whether the checkpoint is brought back too.
        send_to: URL of --out, to which files are sent; None to hand them back.
    """

    name: str
    video: str
    options: dict[str, Any]
    sources: tuple[tuple[str, int], ...] = ()
    cores: int = 1
    gpus: float = 0.0
    memory_mb: float = 0.0
    limit_mb: float | None = None
    limit_s: float | None = None
    scratch: str = ""
    disk_bytes: int | None = None
    checkpoint: bool = False
    send_to: str | None = None


@dataclass(frozen=True, kw_only=True)
class AttemptOutcome:
    """How an attempt ended.

    Attributes:
        exit_code: Of ia-ingest; None if it was killed or lost.
        cause: Why there is no avatar; empty if there is one.
        machine: Where it ran.
        wall_s: Seconds it took.
        core_s: CPU seconds of the process.
        peak_memory_mb: Most memory of the process and its children.
        figures: Excerpt of report.json.
        files: Content by name, relative to the capture's folder.
        interrupted: Whether the batch was stopped; such an attempt does not count.
    """

    exit_code: int | None
    cause: str = ""
    machine: dict[str, Any] = field(default_factory=dict)
    wall_s: float = 0.0
    core_s: float = 0.0
    peak_memory_mb: float = 0.0
    figures: dict[str, Any] = field(default_factory=dict)
    files: dict[str, bytes] = field(default_factory=dict)
    interrupted: bool = False

    @property
    def status(self) -> str:
        """Return "done", "refused" (bad input) or "failed", by the exit code."""
        return attempt_status(self.exit_code)


def attempt_status(exit_code: int | None) -> str:
    """Return "done", "refused" (bad input) or "failed"."""
    known: dict[int | None, str] = {DONE: "done", BAD_INPUT: "refused"}
    return known.get(exit_code, "failed")


def folder_of(name: str, status: str) -> str:
    """Return the folder of a capture's files, relative to --out."""
    return name if status == "done" else f"{FAILED_NAME}/{name}"


def run_attempt(
    job: IngestJob,
    report_progress: Callable[[str], None] = lambda _: None,
    stopped: Callable[[], bool] = lambda: False,
) -> AttemptOutcome:
    """Fetch a capture, run ia-ingest on it, and collect or send what it wrote.

    Args:
        job: What to learn, and within which limits.
        report_progress: Takes the newest line of the log, twice a second.
        stopped: Whether to kill the process now.
    """
    started, machine = time.monotonic(), describe_machine() | {"used_cores": job.cores}
    wanted = sum(size for _, size in job.sources)
    try:
        with work_folder(Path(job.scratch), wanted, job.disk_bytes, stopped) as folder:
            video, options = job.video, job.options
            if job.sources:
                report_progress("fetching the capture")
                video, options = fetch_inputs(job.sources, video, options, folder / "input")
            process = _IngestProcess(job, video, options, folder)
            code, cause = process.wait(report_progress, stopped)
            files = _collect(folder / job.name, folder / LOG_NAME, checkpoint=job.checkpoint)
            figures = read_figures(files.get("report.json", b""))
            if job.send_to is not None and not stopped():
                place = f"{job.send_to}/{folder_of(job.name, attempt_status(code))}"
                send_files(place, files, last=PACKAGE_NAME)
                files = {}
    except InputError as error:
        return AttemptOutcome(exit_code=BAD_INPUT, cause=str(error), machine=machine)
    except (OSError, ImportError) as error:
        cause = f"{type(error).__name__}: {error}"
        wall_s = time.monotonic() - started
        return AttemptOutcome(exit_code=None, cause=cause, machine=machine, wall_s=wall_s)
    return AttemptOutcome(
        exit_code=code,
        cause=cause,
        machine=machine,
        wall_s=time.monotonic() - started,
        core_s=process.core_s,
        peak_memory_mb=process.peak_memory_mb,
        figures=figures,
        files=files,
        interrupted=stopped() and code != DONE,
    )


class _IngestProcess:
    """A running ia-ingest, which never outlives this process."""

    def __init__(self, job: IngestJob, video: str, options: dict[str, Any], folder: Path) -> None:
        self._job, self._log = job, folder / LOG_NAME
        self.core_s = self.peak_memory_mb = 0.0
        cores = str(job.cores)
        path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
        environment = {**os.environ, "TMPDIR": str(folder), "PYTHONPATH": path}
        environment |= {f"{name}_NUM_THREADS": cores for name in ("OMP", "NUMBA", "MKL")}
        words = [video, *ingest_words(options), "--out", job.name]
        module = [sys.executable, "-m", "apps.batching.ingest_attempt", str(os.getpid())]
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [*module, *words], cwd=folder, env=environment, stdin=subprocess.DEVNULL,
                stdout=log, stderr=log, start_new_session=True,
            )  # fmt: skip

    def wait(
        self, report_progress: Callable[[str], None], stopped: Callable[[], bool]
    ) -> tuple[int | None, str]:
        """Wait for the end, or kill the process at a limit; return exit code and cause."""
        began, watched, line, cause = time.monotonic(), 0.0, "", ""
        while not self._has_ended():
            now = time.monotonic()
            if not cause and now - watched >= WATCH_S:
                watched = now
                cause = self._exceeded_limit(now - began, stopped)
                if cause:
                    self._kill()
                newest = _last_line(self._log)
                if newest != line:
                    line = newest
                    report_progress(line)
            time.sleep(POLL_S)
        code = self._process.returncode
        self._kill()  # what it may have left behind
        if cause and code != DONE:
            return None, cause
        if code < 0:
            return None, f"ended by {signal.Signals(-code).name}{_kill_hint(-code)}"
        return code, "" if code == DONE else _failure_message(self._log, code)

    def _has_ended(self) -> bool:
        """Whether the process has ended; then it is reaped, and its CPU time is known."""
        if self._process.returncode is not None:
            return True
        process, status, usage = os.wait4(self._process.pid, os.WNOHANG)
        if process == 0:
            return False
        self._process.returncode = os.waitstatus_to_exitcode(status)
        self.core_s = usage.ru_utime + usage.ru_stime
        unit = 1e6 if sys.platform == "darwin" else 1e3
        self.peak_memory_mb = max(self.peak_memory_mb, usage.ru_maxrss / unit)
        return True

    def _exceeded_limit(self, elapsed_s: float, stopped: Callable[[], bool]) -> str:
        """Return which limit was exceeded; empty for none."""
        if stopped():
            return "the batch was stopped"
        if self._job.limit_s is not None and elapsed_s > self._job.limit_s:
            return f"took longer than {self._job.limit_s:g} s (--limit)"
        memory_mb = tree_memory_mb(self._process.pid)
        self.peak_memory_mb = max(self.peak_memory_mb, memory_mb)
        limit_mb = self._job.limit_mb or MEMORY_SHARE * total_memory_mb()
        if memory_mb > limit_mb:
            return f"took {memory_mb / 1e3:.1f} GB of memory; {limit_mb / 1e3:.1f} GB were allowed"
        return ""

    def _kill(self) -> None:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)


def ingest_words(options: dict[str, Any]) -> list[str]:
    """Return the command line words of options of ia-ingest.

    Args:
        options: By field name; True and False for flags.
    """
    words = []
    for name, value in options.items():
        flag = name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            words += [f"--{flag}", str(value)]
    return words


def read_figures(report: bytes) -> dict[str, Any]:
    """Return quality and cost from the content of report.json; empty without one."""
    try:
        content = json.loads(report)
        held = content.get("held_out_refined") or content["held_out"]
        training, tracking = content["training"], content.get("tracking")
        return {
            "verdict": content["verdict"],
            "psnr": held["psnr"],
            "psnr_given": content["held_out"]["psnr"],
            "ssim": held["ssim"],
            "frames": content["frames"]["used"],
            "steps": training["steps"],
            "training_s": training["wall_seconds"],
            "contention_s": training["cpu_contention_seconds"],
            "package_bytes": (content["package"] or {}).get("bytes"),
            "seen": (content.get("coverage") or {}).get("seen"),
            "tracked": tracking is not None,
        }
    except (ValueError, KeyError, TypeError):
        return {}


def _collect(run: Path, log: Path, *, checkpoint: bool) -> dict[str, bytes]:
    """Read the files of a run that are brought back."""
    files = {LOG_NAME: log.read_bytes()}
    wanted = [run / name for name in KEPT_FILES]
    if checkpoint:
        wanted += sorted(path for path in (run / "checkpoint").rglob("*") if path.is_file())
    for path in wanted:
        if path.is_file():
            files[str(path.relative_to(run))] = path.read_bytes()
    animation = ANIMATION.search(files.get("report.html", b"").decode(errors="replace"))
    if animation is not None:
        files[TURNING_NAME] = base64.b64decode(animation[1])
    return files


def _last_line(log: Path) -> str:
    """Return the last line of a log; empty if there is none."""
    with log.open("rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - LOG_TAIL_BYTES))
        lines = file.read().decode(errors="replace").split("\n")
    return next((line.strip() for line in reversed(lines) if line.strip()), "")


def _failure_message(log: Path, code: int) -> str:
    """Return what ia-ingest said last, without its name."""
    line = _last_line(log)
    return re.sub(r"^ia-ingest: ", "", line) or f"ia-ingest ended with exit code {code}"


def _kill_hint(number: int) -> str:
    """Return the usual reason of a signal."""
    reasons: dict[int, str] = {
        signal.SIGKILL: " (by another program, or because the machine ran out of memory)",
        signal.SIGSEGV: " (a crash in native code)",
    }
    return reasons.get(number, "")


# --- in the process ------------------------------------------------------------------------------


def run_in_child() -> int:
    """Run ia-ingest in this process, which ends with its parent."""
    parent = int(sys.argv[1])
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
        if os.getppid() != parent:  # it ended before this call
            return 1
        with suppress(OSError):
            Path("/proc/self/oom_score_adj").write_text(str(OOM_SCORE), encoding="ascii")
    from apps.ingest import main

    sys.argv[0] = "ia-ingest"
    return main(sys.argv[2:])


if __name__ == "__main__":
    sys.exit(run_in_child())

"""Attempts to learn a capture, each ia-ingest in a process of its own, and what is left of them.

They are tasks of a Ray cluster, which places them and repeats those that fail.
"""

import faulthandler
import json
import logging
import os
import signal
import time
import traceback
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TextIO

from rich.console import Console as RichConsole

from capture.hardware import describe_machine, peak_memory_mb, usable_cores
from capture.input_error import InputError
from instant_avatar.batching.batch_arguments import RAY_LOCAL, BatchArguments
from instant_avatar.batching.capture_discovery import BatchCapture
from instant_avatar.batching.remote_files import fetch_files, is_url
from instant_avatar.cli.command_line import (
    BAD_INPUT,
    DONE,
    NO_AVATAR,
    CommandExit,
    describe_failure,
    parse_arguments,
)
from instant_avatar.cli.console import Console
from instant_avatar.run.ingest_arguments import IngestArguments

LOG_NAME = "ingest.log"
"""Output of ia-ingest."""
ANIMATION_NAME = "turning.webp"
"""The animation of the report."""
PACKAGE_NAME = "avatar.iavatar"
"""The avatar."""
KEPT_FILES = (
    PACKAGE_NAME, ANIMATION_NAME, "report.json", "report.html", "cameras.npz", "poses.npz",
    "tracking/poses.npz", "tracking/grade.json", "tracking/skeleton.mp4",
)  # fmt: skip
"""Files of a run that are brought back."""
STATUSES = {DONE: "done", BAD_INPUT: "refused"}
"""Status of a capture by the exit code of ia-ingest; all others are failures."""
BATCH_FORCE = "the same command with --again, and --force after --"
"""How a batch goes on with poses that are not good enough; what is done is left alone."""


@dataclass(frozen=True, kw_only=True)
class AttemptRecord:
    """A line of results.jsonl.

    Attributes:
        attempt: Number of the line for this input with these options, from 1.
        status: "done", "refused" (bad input, never tried again) or "failed".
        exit_code: Of ia-ingest; null if it was killed or lost.
        cause: Why there is no avatar; empty if there is one.
        input: Fingerprint of the capture's files.
        options: Fingerprint of its options.
        started, ended: Time of day, seconds since 1970.
        wall_s: Seconds that the last attempt took.
        core_s: CPU seconds of its process and the children of it.
        peak_memory_mb: Most memory of its process.
        machine: Host, processor, cores, memory, the cores that were asked for, and Ray's node.
        figures: Quality and cost from report.json.
    """

    capture: str
    video: str
    attempt: int = 1
    status: str
    exit_code: int | None
    cause: str
    input: str
    options: str
    started: float
    ended: float
    wall_s: float = 0.0
    core_s: float = 0.0
    peak_memory_mb: float = 0.0
    machine: dict[str, Any] = field(default_factory=dict)
    figures: dict[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> tuple[str, str]:
        """Fingerprints of files and options."""
        return self.input, self.options


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """A result, and the files of a capture by relative name."""

    record: AttemptRecord
    files: dict[str, bytes] = field(default_factory=dict)


class AttemptFailure(Exception):  # noqa: N818 - of an attempt, which may be made again
    """An attempt that has failed for other reasons than bad input."""

    def __init__(self, attempt: Attempt) -> None:
        """Carry what is left of it."""
        super().__init__(attempt)
        self.attempt = attempt

    def __str__(self) -> str:
        """Return the cause."""
        return self.attempt.record.cause


def record_of(
    capture: BatchCapture, exit_code: int | None, cause: str, **more: Any
) -> AttemptRecord:
    """Return the line of a capture that ended now with an exit code."""
    ended = time.time()
    return AttemptRecord(
        capture=capture.name,
        video=capture.video,
        status="failed" if exit_code is None else STATUSES.get(exit_code, "failed"),
        exit_code=exit_code,
        cause=cause,
        input=capture.input_key,
        options=capture.options_key,
        ended=ended,
        **{"started": ended, **more},
    )


def learn_capture(capture: BatchCapture, arguments: BatchArguments, scratch: str | None) -> Attempt:
    """Fetch a capture, run ia-ingest on it in this process, and collect what it wrote.

    Raises:
        AttemptFailure: If there is no avatar although the input is good.
    """
    cores = arguments.cores_of(capture)
    for library in ("OMP", "NUMBA", "MKL"):  # they look once, when they are loaded
        os.environ[f"{library}_NUM_THREADS"] = str(cores)
    started, core_s = time.time(), sum(os.times()[:4])
    with TemporaryDirectory(prefix="ia-batch-", dir=scratch) as folder:
        run, log = Path(folder, capture.name), Path(folder, LOG_NAME)
        with log.open("w", encoding="utf-8") as text:
            code, cause = _ingest(capture, run, text, cores, arguments.limit)
        files = {LOG_NAME: log.read_bytes()} | _collect(run, checkpoint=arguments.checkpoints)
    record = record_of(
        capture,
        code,
        cause,
        started=started,
        wall_s=round(time.time() - started, 2),
        core_s=round(sum(os.times()[:4]) - core_s, 2),
        peak_memory_mb=round(peak_memory_mb(), 1),
        machine=describe_machine() | {"used_cores": cores},
        figures=read_figures(files.get("report.json", b"")),
    )
    attempt = Attempt(record=record, files=files)
    if record.status == "failed":
        raise AttemptFailure(attempt)
    return attempt


def _ingest(
    capture: BatchCapture, run: Path, log: TextIO, cores: int, limit_s: float
) -> tuple[int, str]:
    """Run ia-ingest; return its exit code, and why there is no avatar."""
    try:
        with _time_limit(limit_s, log):
            from instant_avatar.ingest import ingest  # heavy, and of the threads that were just set

            local = fetch_files(filter(is_url, capture.places()), capture.sources, run.parent)
            words = [local.get(capture.video, capture.video), "--threads", str(cores)]
            for option, path in capture.paths.items():
                words += [option, local.get(path, path)]
            words += [*capture.options, "--out", str(run)]
            arguments = parse_arguments(IngestArguments, "ia-ingest", words)
            return ingest(arguments, Console(RichConsole(file=log, soft_wrap=True))), ""
    except Exception as error:
        failure = describe_failure(error)
        if failure is not None:
            from instant_avatar.run.run_tracking import FORCE

            code, cause = failure
            return code, cause.replace(f"{run}{os.sep}", "").replace(FORCE, BATCH_FORCE)
        traceback.print_exc(file=log)
        return NO_AVATAR, f"{type(error).__name__}: {error}"


@contextmanager
def _time_limit(seconds: float, log: TextIO) -> Iterator[None]:
    """Raise `CommandExit` in a block that takes too long; end the process if that fails."""

    def stop(signal_number: int, frame: object) -> None:
        raise CommandExit(f"took longer than {seconds:g} s (--limit)", NO_AVATAR)

    if seconds:
        if hasattr(signal, "SIGALRM"):  # not on Windows, where the process is ended instead
            signal.signal(signal.SIGALRM, stop)
            signal.setitimer(signal.ITIMER_REAL, seconds)
        # it may end by itself first
        faulthandler.dump_traceback_later(seconds + 60.0, exit=True, file=log)
    try:
        yield
    finally:
        if hasattr(signal, "SIGALRM"):
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        faulthandler.cancel_dump_traceback_later()


def _collect(run: Path, *, checkpoint: bool) -> dict[str, bytes]:
    paths = [run / name for name in KEPT_FILES]
    paths += sorted((run / "checkpoint").rglob("*")) if checkpoint else []
    return {str(path.relative_to(run)): path.read_bytes() for path in paths if path.is_file()}


def read_figures(report: bytes) -> dict[str, Any]:
    """Return quality and cost from the content of report.json; empty without one."""
    if not report:
        return {}
    content = json.loads(report)
    held = content["held_out_refined"] or content["held_out"]
    return {
        "verdict": content["verdict"],
        "psnr": held["psnr"],
        "psnr_given": content["held_out"]["psnr"],
        "ssim": held["ssim"],
        "frames": content["frames"]["used"],
        "steps": content["training"]["steps"],
        "training_s": content["training"]["wall_seconds"],
        "package_bytes": (content["package"] or {}).get("bytes"),
        "seen": (content["coverage"] or {}).get("seen"),
        "tracked": content["tracking"] is not None,
    }


def run_attempts(
    captures: Iterable[BatchCapture], arguments: BatchArguments
) -> Generator[Attempt, None, None]:
    """Learn captures, and yield the last attempt at each as it ends.

    Closing the iterator ends what runs.
    """
    import ray

    captures = list(captures)
    with TemporaryDirectory(prefix="ia-batch-") as folder:  # also of workers that are killed
        scratch = folder if arguments.ray == RAY_LOCAL else None
        _connect(ray, arguments.ray)
        try:
            memory = int(1e9 * arguments.memory)
            needs = {
                capture.name: {"num_cpus": arguments.cores_of(capture), "memory": memory}
                for capture in captures
            }
            _check_room(ray, needs.values())
            once: dict[str, Any] = {"max_calls": 1}  # each attempt has a process of its own
            retries = {"max_retries": arguments.retries, "retry_exceptions": [AttemptFailure]}
            task = ray.remote(**once, **retries)(learn_capture)
            running = {
                task.options(name=capture.name, **needs[capture.name]).remote(
                    capture, arguments, scratch
                ): capture
                for capture in captures
            }
            while running:
                (ended,), _ = ray.wait(list(running), num_returns=1)
                yield _attempt(ray, ended, running.pop(ended))
        finally:
            ray.shutdown()


def _connect(ray: Any, address: str) -> None:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent anywhere
    own: dict[str, Any] = {}
    if address == RAY_LOCAL:
        # attempts bring back about 5 MB each
        own = {"num_cpus": usable_cores(), "object_store_memory": 200_000_000}
        own["include_dashboard"] = False
    on_sigterm = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **own)
    except Exception as error:  # a start that takes too long has no class of its own
        if address == RAY_LOCAL:
            raise InputError(
                f"Ray did not start on this machine ({error}). Is it busy? Run the command again."
            ) from error
        raise InputError(
            f"--ray {address}: there is no cluster to connect to ({error}). Start one: ray start "
            "--head; or omit --ray to use this machine alone."
        ) from error
    signal.signal(signal.SIGTERM, on_sigterm)  # Ray's own would print a stack and exit


def _check_room(ray: Any, needs: Iterable[dict[str, int]]) -> None:
    """Raise if a capture fits no node: its task would wait for ever."""
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    sizes = [(int(node.get("CPU", 0)), int(node.get("memory", 0))) for node in nodes]
    for need in needs:
        cores, memory = need["num_cpus"], need["memory"]
        if not any(cores <= most and memory <= available for most, available in sizes):
            present = ", ".join(f"{most} cores with {each / 1e9:.1f} GB" for most, each in sizes)
            raise InputError(
                f"No node has {cores} cores with {memory / 1e9:.1f} GB for a capture; there are "
                f"{present}. Lower --cores or --memory, or add a larger node."
            )


def _attempt(ray: Any, task: Any, capture: BatchCapture) -> Attempt:
    try:
        return ray.get(task)
    except ray.exceptions.RayTaskError as error:
        if isinstance(error.cause, AttemptFailure):
            return error.cause.attempt
        cause = f"{type(error.cause).__name__}: {error.cause}"
    except ray.exceptions.OutOfMemoryError:
        cause = "its node ran out of memory, and Ray ended the attempt"
    except ray.exceptions.RayError as error:
        cause = f"its process or its node was lost ({type(error).__name__})"
    return Attempt(record=record_of(capture, None, cause), files={LOG_NAME: cause.encode()})

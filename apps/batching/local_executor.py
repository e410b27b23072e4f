"""Runs attempts on this machine, as many at once as its cores and its memory allow."""

import queue
import threading
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from os import getpid
from typing import Protocol, final, runtime_checkable

from apps.batching.ingest_attempt import AttemptOutcome, IngestJob, run_attempt
from apps.batching.node_resources import available_memory_mb, tree_memory_mb
from apps.report.hardware import usable_cores


@dataclass(frozen=True, kw_only=True)
class AttemptProgress:
    """What a running attempt printed last, where it runs, and since when (monotonic seconds)."""

    line: str
    host: str
    since: float


@runtime_checkable
class AttemptExecutor(Protocol):
    """Runs attempts, each by `run_attempt`."""

    def has_room(self, job: IngestJob) -> bool:
        """Whether a job may be started now."""
        ...

    def start(self, job: IngestJob) -> None:
        """Start a job, or queue it."""
        ...

    def finished(self, timeout_s: float) -> list[tuple[IngestJob, AttemptOutcome]]:
        """Return jobs that have ended since the last call; wait for one up to a time."""
        ...

    def progress(self) -> Mapping[str, AttemptProgress]:
        """Return the progress of running jobs by the capture's name."""
        ...

    def kill(self) -> None:
        """Kill all running jobs; `finished` still returns them."""
        ...

    def close(self) -> None:
        """Release what the executor holds."""
        ...


@final
class LocalExecutor:
    """Threads of this process, each waiting for an ia-ingest process."""

    def __init__(self, cores: int | None = None) -> None:
        """Use this many cores; None for all that this process may use."""
        self._cores = cores or usable_cores()
        self._threads = ThreadPoolExecutor(self._cores)
        self._ended: queue.Queue[tuple[IngestJob, AttemptOutcome]] = queue.Queue()
        self._running: dict[str, IngestJob] = {}
        self._progress: dict[str, AttemptProgress] = {}
        self._killed = threading.Event()

    def has_room(self, job: IngestJob) -> bool:
        """Whether cores, GPUs and memory are free; one job always fits.

        Running jobs may still grow to what was asked for, so their missing part counts as used.
        """
        if not self._running:
            return True
        jobs = [*self._running.values(), job]
        if sum(each.cores for each in jobs) > self._cores or sum(each.gpus for each in jobs) > 1.0:
            return False
        wanted_mb = sum(each.memory_mb for each in jobs)
        return available_memory_mb() + tree_memory_mb(getpid()) >= wanted_mb

    def start(self, job: IngestJob) -> None:
        """Start a job on a thread."""
        self._running[job.name] = job
        self._show(job.name, time.monotonic(), "starting")
        future = self._threads.submit(
            run_attempt, job, partial(self._show, job.name, time.monotonic()), self._killed.is_set
        )
        future.add_done_callback(partial(self._end, job))

    def finished(self, timeout_s: float) -> list[tuple[IngestJob, AttemptOutcome]]:
        """Return jobs that have ended; see `AttemptExecutor`."""
        found = []
        try:
            found.append(self._ended.get(timeout=timeout_s))
            while True:
                found.append(self._ended.get_nowait())
        except queue.Empty:
            pass
        for job, _ in found:
            del self._running[job.name]
            self._progress.pop(job.name, None)
        return found

    def progress(self) -> Mapping[str, AttemptProgress]:
        """Return the progress of running jobs by the capture's name."""
        return dict(self._progress)

    def kill(self) -> None:
        """Kill all running jobs."""
        self._killed.set()

    def close(self) -> None:
        """Kill what still runs, and wait for it."""
        self.kill()
        self._threads.shutdown()

    def _show(self, name: str, since: float, line: str) -> None:
        self._progress[name] = AttemptProgress(line=line, host="", since=since)

    def _end(self, job: IngestJob, future: "Future[AttemptOutcome]") -> None:
        error = future.exception()
        if error is None:
            self._ended.put((job, future.result()))
        else:
            cause = f"{type(error).__name__}: {error}"
            self._ended.put((job, AttemptOutcome(exit_code=None, cause=cause)))

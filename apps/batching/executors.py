"""What runs attempts: this machine, as its cores and its memory allow, or a Ray cluster.

On a cluster each attempt is a task, with its cores, GPUs and memory as resources.
"""

import logging
import os
import queue
import threading
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from os import getpid
from typing import Any, Protocol, final, runtime_checkable

from apps.batching.ingest_attempt import AttemptOutcome, IngestJob, run_attempt
from apps.cli.command_line import DISTRIBUTION
from apps.cli.hardware import available_memory_mb, tree_memory_mb, usable_cores
from capture.input_error import InputError


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


RAY_LOCAL = "local"
"""Address that starts a cluster of this machine alone."""
PROGRESS_TIMEOUT_S = 5.0
"""Longest wait for the progress of all attempts, seconds."""


@final
class ProgressBoard:
    """An actor that holds what each running attempt printed last."""

    def __init__(self) -> None:
        """Start without attempts."""
        self._shown: dict[str, tuple[str, str, float]] = {}

    def show(self, name: str, line: str, host: str) -> None:
        """Note a line, and since when its attempt runs."""
        before = self._shown.get(name)
        same = before is not None and before[1] == host
        since = before[2] if before is not None and same else time.monotonic()
        self._shown[name] = (line, host, since)

    def forget(self, name: str) -> None:
        """Remove an attempt that has ended."""
        self._shown.pop(name, None)

    def read(self) -> dict[str, tuple[str, str, float]]:
        """Return line, host and seconds since the start of each attempt."""
        now = time.monotonic()
        return {name: (line, host, now - at) for name, (line, host, at) in self._shown.items()}


@final
class RayExecutor:
    """Tasks of a Ray cluster; lost workers and nodes are failed attempts."""

    def __init__(self, address: str, job: IngestJob) -> None:
        """Connect to a cluster, or start one on this machine.

        Args:
            address: "local", "auto", or HOST:PORT.
            job: An attempt that some node must have room for.

        Raises:
            InputError: If Ray is missing, there is no cluster, or no node is large enough.
        """
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent anywhere
        self._ray = ray = _import_ray()
        own: dict[str, Any] = {"include_dashboard": False} if address == RAY_LOCAL else {}
        try:
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **own)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise InputError(
                f"--ray {address}: there is no cluster to connect to ({error}). Start one: ray "
                "start --head; or omit the address to use this machine alone."
            ) from error
        try:
            self._check_nodes(job)
        except InputError:
            ray.shutdown()
            raise
        place = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(
            ray.get_runtime_context().get_node_id(), soft=True
        )
        board = ray.remote(num_cpus=0, scheduling_strategy=place)(ProgressBoard)
        self._board = board.remote()
        self._task = ray.remote(max_retries=0)(run_on_node)
        self._jobs: dict[Any, IngestJob] = {}
        self._progress: dict[str, AttemptProgress] = {}
        self._killed = False

    def has_room(self, job: IngestJob) -> bool:
        """Whether another task may wait: as many as run, so that a growing cluster has work."""
        slots = int(self._ray.cluster_resources().get("CPU", 0)) // job.cores
        return len(self._jobs) < 2 * slots + 1

    def start(self, job: IngestJob) -> None:
        """Submit a task."""
        task = self._task.options(
            num_cpus=job.cores,
            num_gpus=job.gpus,
            memory=int(1e6 * job.memory_mb),
            name=f"ia-ingest {job.name}",
        )
        self._jobs[task.remote(job, self._board)] = job

    def finished(self, timeout_s: float) -> list[tuple[IngestJob, AttemptOutcome]]:
        """Return jobs that have ended; see `AttemptExecutor`."""
        if not self._jobs:
            return []
        waiting = list(self._jobs)
        ready, _ = self._ray.wait(waiting, num_returns=1, timeout=timeout_s, fetch_local=False)
        if ready:
            ready, _ = self._ray.wait(
                waiting, num_returns=len(waiting), timeout=0, fetch_local=False
            )
        ended = [(self._jobs.pop(task), self._outcome(task)) for task in ready]
        for job, _ in ended:
            self._board.forget.remote(job.name)
        return ended

    def progress(self) -> Mapping[str, AttemptProgress]:
        """Return the progress of running jobs by the capture's name."""
        try:
            shown = self._ray.get(self._board.read.remote(), timeout=PROGRESS_TIMEOUT_S)
        except self._ray.exceptions.RayError:
            return self._progress
        now, names = time.monotonic(), {job.name for job in self._jobs.values()}
        self._progress = {
            name: AttemptProgress(line=line, host=host, since=now - seconds)
            for name, (line, host, seconds) in shown.items()
            if name in names
        }
        return self._progress

    def kill(self) -> None:
        """Cancel all tasks; their processes end with their workers."""
        self._killed = True
        for task in self._jobs:
            self._ray.cancel(task, force=True)

    def close(self) -> None:
        """Disconnect; tasks that run are killed, and so is a cluster that was started here."""
        self._ray.shutdown()

    def _outcome(self, task: Any) -> AttemptOutcome:
        errors = self._ray.exceptions
        try:
            return self._ray.get(task)
        except errors.OutOfMemoryError:
            cause = "the node ran out of memory, and Ray ended this attempt"
        except errors.RayTaskError as error:
            cause = str(error).strip().splitlines()[-1]
        except errors.RayError as error:
            cause = f"the node or its worker was lost ({type(error).__name__})"
        return AttemptOutcome(exit_code=None, cause=cause, interrupted=self._killed)

    def _check_nodes(self, job: IngestJob) -> None:
        """Raise unless some node could run an attempt."""
        wanted = {"CPU": job.cores, "memory": 1e6 * job.memory_mb, "GPU": job.gpus}
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        if any(all(node.get(key, 0) >= value for key, value in wanted.items()) for node in nodes):
            return
        found = ", ".join(
            f"{node.get('CPU', 0):g} cores with {node.get('memory', 0) / 1e9:.1f} GB"
            for node in nodes
        )
        raise InputError(
            f"No node of the cluster has {job.cores} cores with {job.memory_mb / 1e3:.1f} GB for a "
            f"capture; it has {found}. Lower --cores or --memory, or add a larger node."
        )


def run_on_node(job: IngestJob, board: Any) -> AttemptOutcome:
    """Run an attempt in a Ray worker.

    Args:
        job: What to learn.
        board: Handle of a `ProgressBoard`.
    """
    ray = _import_ray()
    node = ray.get_runtime_context().get_node_id()[:8]
    board.show.remote(job.name, "starting", node)
    outcome = run_attempt(job, lambda line: board.show.remote(job.name, line, node))
    return replace(outcome, machine=outcome.machine | {"node": node})


def _import_ray() -> Any:
    try:
        import ray
        import ray.util.scheduling_strategies
    except ImportError as error:
        raise InputError(
            f"--ray requires Ray, which is not installed ({error}). Install it with: pip install "
            f"'{DISTRIBUTION}[cluster]'. Without --ray, captures are learnt on this machine."
        ) from error
    return ray

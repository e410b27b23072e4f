"""Decides what is learnt, again or not at all, and records every attempt."""

import math
import threading
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import final

from apps.batching.batch_folder import AttemptRecord, BatchFolder
from apps.batching.capture_discovery import BatchCapture
from apps.batching.ingest_attempt import AttemptOutcome, IngestJob
from apps.batching.live_table import CaptureState, LiveTable
from apps.batching.local_executor import AttemptExecutor

FIRST_NEED_MB = 2500.0
"""Memory to ask for until a capture has been measured, MB: a tracked film of 300 frames took 2,242
(docs/scale.md)."""
NEED_MARGIN = 1.15
"""Factor from the most memory measured to what captures ask for."""
POLL_S = 0.5
"""Interval at which the table is drawn, seconds."""


@dataclass(frozen=True, kw_only=True)
class BatchLimits:
    """What attempts may use, and how often a capture is tried.

    Attributes:
        job: What all jobs have in common; names, videos and options are filled in.
        retries: Attempts after the first failed one.
        again: Whether captures that were refused or have failed before are tried again.
        gpus: GPUs, or a fraction of one, per capture with --device cuda.
        at_once: Most attempts at once; None for as many as the executor has room for.
    """

    job: IngestJob
    retries: int
    again: bool = False
    gpus: float = 1.0
    at_once: int | None = None


def plan_captures(
    captures: Iterable[BatchCapture], folder: BatchFolder, limits: BatchLimits
) -> list[CaptureState]:
    """Compare the captures with the results: what is done stays done, what changed is learnt.

    Args:
        captures: All captures of the batch.
        folder: With the results of earlier batches.
        limits: How often a capture is tried.

    Raises:
        InputError: If files of another program lie where an avatar would be written.
    """
    known: dict[tuple[str, str, str], list[AttemptRecord]] = {}
    for record in folder.records:
        known.setdefault((record.capture, record.input, record.options), []).append(record)
    states = []
    for capture in captures:
        records = known.get((capture.name, capture.input_key, capture.options_key), [])
        done = [record for record in records if record.status == "done"]
        if done and folder.has_package(capture.name):
            state = CaptureState(capture=capture, status="done", record=done[-1])
        elif records and not done and not limits.again:
            failed = records[-1].status == "refused" or len(records) > limits.retries
            status = records[-1].status if failed else "waiting"
            state = CaptureState(capture=capture, status=status, record=records[-1])
        else:
            state = CaptureState(capture=capture, status="waiting")
        if state.status == "waiting":
            folder.check_place(capture.name)
        states.append(replace(state, attempts=len(records)))
    return states


@final
class BatchScheduler:
    """Starts attempts while there is room, and records how they end.

    Attributes:
        states: State of each capture by name.
    """

    def __init__(
        self,
        states: Iterable[CaptureState],
        folder: BatchFolder,
        executor: AttemptExecutor,
        limits: BatchLimits,
        table: LiveTable,
    ) -> None:
        """Queue the captures that wait.

        Args:
            states: Of all captures.
            folder: Takes results and avatars.
            executor: Runs the attempts.
            limits: What attempts may use.
            table: Shows the states.
        """
        self.states = {state.capture.name: state for state in states}
        self._folder, self._executor, self._limits, self._table = folder, executor, limits, table
        waiting = (name for name, state in self.states.items() if state.status == "waiting")
        self._queue = deque(waiting)
        self._tries = dict.fromkeys(self._queue, 0)
        if not limits.again:
            self._tries |= {name: self.states[name].attempts for name in self._queue}
        self._need_mb = max(
            (record.peak_memory_mb for record in folder.records if record.status == "done"),
            default=0.0,
        )
        self._started_at: dict[str, float] = {}

    def run(self, stop: threading.Event, kill: threading.Event) -> None:
        """Learn all captures that wait.

        Args:
            stop: Once it is set, nothing is started any more.
            kill: Once it is set, what runs is killed.

        Raises:
            OSError: If the disk is full; captures that run are then learnt by the next batch.
        """
        while self._started_at or (self._queue and not stop.is_set()):
            if kill.is_set():
                self._executor.kill()
            while self._queue and not stop.is_set() and not kill.is_set():
                job = self._make_job(self.states[self._queue[0]].capture)
                full = len(self._started_at) >= (self._limits.at_once or math.inf)
                if full or not self._executor.has_room(job):
                    break
                self._queue.popleft()
                self._start(job)
            for job, outcome in self._executor.finished(POLL_S):
                self._end(job, outcome)
            self._table.show(self.states.values(), self._executor.progress())

    def _make_job(self, capture: BatchCapture) -> IngestJob:
        common, options = self._limits.job, dict(capture.options)
        cores = options.setdefault("threads", common.cores)
        asked_mb = NEED_MARGIN * self._need_mb if self._need_mb else FIRST_NEED_MB
        return replace(
            common,
            name=capture.name,
            video=capture.video,
            options=options,
            sources=capture.sources,
            cores=cores,
            gpus=self._limits.gpus if options.get("device") == "cuda" else 0.0,
            memory_mb=common.limit_mb or asked_mb,
            send_to=self._folder.url,
        )

    def _start(self, job: IngestJob) -> None:
        self._started_at[job.name] = time.time()
        self._set(job.name, status="learning")
        self._executor.start(job)

    def _end(self, job: IngestJob, outcome: AttemptOutcome) -> None:
        """Place the files of an attempt, record it, and try the capture again if that may help."""
        started, state = self._started_at.pop(job.name), self.states[job.name]
        if outcome.interrupted:
            self._set(job.name, status="waiting")
            return
        status = outcome.status
        self._folder.place_files(job.name, outcome.files, status)
        record = AttemptRecord(
            capture=job.name,
            video=job.video,
            attempt=state.attempts + 1,
            status=status,
            exit_code=outcome.exit_code,
            cause=outcome.cause,
            input=state.capture.input_key,
            options=state.capture.options_key,
            started=started,
            ended=time.time(),
            wall_s=round(outcome.wall_s, 2),
            core_s=round(outcome.core_s, 2),
            peak_memory_mb=round(outcome.peak_memory_mb, 1),
            machine=outcome.machine,
            figures=outcome.figures,
            part=self._folder.part_text,
        )
        self._folder.append(record)
        self._tries[job.name] += 1
        if status == "done":
            self._need_mb = max(self._need_mb, outcome.peak_memory_mb)
        final = status != "failed" or self._tries[job.name] > self._limits.retries
        if not final:
            self._queue.append(job.name)
        self._set(
            job.name,
            status=status if final else "waiting",
            record=record,
            attempts=record.attempt,
            is_new=True,
        )
        self._table.log(self.states[job.name])

    def _set(self, name: str, **changes: object) -> None:
        self.states[name] = replace(self.states[name], **changes)

"""Decides what is learnt, again or not at all, records every attempt, and shows them as a table."""

import math
import re
import threading
import time
from collections import Counter, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from types import TracebackType
from typing import final

from rich.console import Console as RichConsole
from rich.console import Group
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from apps.batching.batch_folder import AttemptRecord, BatchFolder
from apps.batching.capture_discovery import BatchCapture
from apps.batching.executors import AttemptExecutor, AttemptProgress
from apps.batching.ingest_attempt import AttemptOutcome, IngestJob
from apps.cli.console import LOG_INTERVAL_S, format_duration
from apps.report.report_schema import format_psnr

STATUS_COLORS = {
    "waiting": "dim", "learning": "cyan", "done": "green", "refused": "yellow", "failed": "red",
}  # fmt: skip
"""States of a capture, in order, with their colors."""
MAX_ROWS = 16
"""Running captures that are listed."""
MAX_ENDED = 8
"""Ended captures that are listed."""
QUALITY = re.compile(r"(-?\d+\.\d+) dB(?: \(([a-z ]+)\))?")
"""A PSNR in the output of ia-ingest."""


@dataclass(frozen=True, kw_only=True)
class CaptureState:
    """A capture, and how far it is.

    Attributes:
        capture: The capture.
        status: See `STATUS_COLORS`.
        attempts: Attempts at this input with these options, in all batches.
        record: The last attempt that counts, if any.
        is_new: Whether it was made by this batch.
    """

    capture: BatchCapture
    status: str
    attempts: int = 0
    record: AttemptRecord | None = None
    is_new: bool = False


@final
class LiveTable:
    """Shows the states of all captures."""

    def __init__(self, console: RichConsole) -> None:
        """Draw on a console; used as a context."""
        self._console, self._live = console, Live(console=console, auto_refresh=False)
        self._ended: deque[CaptureState] = deque(maxlen=MAX_ENDED)
        self._quality: dict[str, str] = {}
        self._began = self._logged_at = time.monotonic()

    def __enter__(self) -> "LiveTable":
        """Start drawing."""
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Stop drawing; the last table stays."""
        if self._console.is_terminal:
            self._live.stop()

    def show(self, states: Iterable[CaptureState], progress: Mapping[str, AttemptProgress]) -> None:
        """Draw the table; in a log, a line of counts every `LOG_INTERVAL_S` seconds."""
        states = [
            replace(state, status="waiting")
            if state.status == "learning" and state.capture.name not in progress
            else state
            for state in states
        ]  # submitted to a cluster that has no room yet
        for name, each in progress.items():
            found = QUALITY.findall(each.line)
            if found:
                self._quality[name] = f"{found[-1][0]} dB"
        if self._console.is_terminal:
            self._live.update(self._draw(states, progress), refresh=True)
        elif time.monotonic() - self._logged_at >= LOG_INTERVAL_S:
            self._logged_at = time.monotonic()
            self._console.print(f"{self._counts(states, color=False)}", highlight=False)

    def log(self, state: CaptureState) -> None:
        """Note the end of an attempt; causes are printed on a terminal, too."""
        self._quality.pop(state.capture.name, None)
        self._ended.append(state)
        if not self._console.is_terminal or state.status in ("refused", "failed"):
            self._console.print(escape(_ended_line(state)), highlight=False)

    def _draw(self, states: list[CaptureState], progress: Mapping[str, AttemptProgress]) -> Group:
        table, now = Table(box=None, pad_edge=False, expand=True), time.monotonic()
        for heading in ("capture", "state", "time", "quality", "now"):
            table.add_column(heading, no_wrap=True, overflow="ellipsis")
        running = [state for state in states if state.capture.name in progress]
        for state in running[:MAX_ROWS]:
            each = progress[state.capture.name]
            doing = f"{each.host}: {each.line}" if each.host else each.line
            table.add_row(
                escape(state.capture.name),
                "[cyan]learning[/]" + (f" ({state.attempts + 1})" if state.attempts else ""),
                format_duration(now - each.since),
                self._quality.get(state.capture.name, ""),
                escape(doing),
            )
        if len(running) > MAX_ROWS:
            table.add_row(f"… and {len(running) - MAX_ROWS} more", "", "", "", "")
        for state in self._ended:
            record = state.record
            assert record is not None
            color = STATUS_COLORS[record.status]
            quality = format_psnr(record.figures.get("psnr"), None, digits=1)
            table.add_row(
                escape(state.capture.name),
                f"[{color}]{record.status}[/]",
                format_duration(record.wall_s),
                quality if record.status == "done" else "",
                escape(record.figures.get("verdict") or record.cause),
            )
        return Group(self._counts(states, color=True), table)

    def _counts(self, states: list[CaptureState], *, color: bool) -> str:
        """Return how many captures are in which state, and the time that remains."""
        counted = Counter(state.status for state in states)
        words = [
            f"[{shade}]{counted[status]} {status}[/]" if color else f"{counted[status]} {status}"
            for status, shade in STATUS_COLORS.items()
        ]
        ended = sum(s.is_new and s.status in ("done", "failed") for s in states)
        left = counted["waiting"] + counted["learning"]
        text = " · ".join(words)
        if ended and left:
            each_s = (time.monotonic() - self._began) / ended
            text += f" · about {format_duration(each_s * left)} left"
        return text


def _ended_line(state: CaptureState) -> str:
    """Return the line of a log about an attempt that has ended."""
    record = state.record
    assert record is not None
    name, took = state.capture.name, format_duration(record.wall_s)
    if record.status == "done":
        score = format_psnr(record.figures.get("psnr"), record.figures.get("verdict"))
        return f"done     {name}: {score}, {took}"
    again = " (tried again)" if state.status == "waiting" else ""
    return f"{record.status:<8} {name}: {record.cause}{again}"


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

"""The live table of a batch on a terminal; a line per finished capture in a log."""

import re
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

from apps.batching.batch_folder import AttemptRecord
from apps.batching.capture_discovery import BatchCapture
from apps.batching.local_executor import AttemptProgress
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

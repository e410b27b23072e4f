"""What a command says while it works: a live line on a terminal, plain lines in a log."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import TracebackType
from typing import final

from rich.console import Console as RichConsole
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from rich.table import Column

MAX_PRINTED_WARNINGS = 5
"""Warnings that are printed; the rest are counted, and all stand in the report."""
MAX_KEPT_WARNINGS = 500
"""Warnings that are kept, so that memory stays bounded however long a video lasts."""
LOG_INTERVAL_S = 10.0
MIN_BAR_WIDTH = 8
"""Characters of a bar beside a long note."""
MIN_ELAPSED_FOR_ESTIMATE_S, MIN_SHARE_FOR_ESTIMATE = 2.0, 0.15
"""Before that time, and before that share is done, too little is known to say how long the rest
takes."""


def format_duration(seconds: float) -> str:
    """A duration as people say it: "5 s", "40 s", "2 min"; above ten seconds in steps of five."""
    if seconds > 90.0:
        return f"{seconds / 60.0:.0f} min"
    return f"{5 * round(seconds / 5.0) if seconds > 10.0 else max(1, round(seconds))} s"


@final
class StderrConsole(RichConsole):
    """What people read; once nobody does (`… 2>&1 | head`), the work goes on in silence."""

    def __init__(self) -> None:
        """Lines are as long as they are."""
        super().__init__(stderr=True, soft_wrap=True)

    def on_broken_pipe(self) -> None:
        """The reader has gone; rich would end the process."""
        self.quiet = True


@final
class Console:
    """Messages on stderr, so that stdout stays free for what was made.

    Attributes:
        warnings: Every warning so far; of very many the first `MOST_KEPT`.
    """

    def __init__(self, console: RichConsole | None = None) -> None:
        """A console on stderr, unless another is given."""
        self._rich = console or StderrConsole()
        self.warnings: list[str] = []
        self._discarded_warnings = 0

    @property
    def is_terminal(self) -> bool:
        """Whether somebody watches."""
        return self._rich.is_terminal

    def info(self, message: str) -> None:
        """A line."""
        self._rich.print(escape(message), highlight=False)

    def info_before_exit(self, message: str) -> None:
        """A line, from wherever the command is; the terminal gets its cursor back."""
        self._rich.show_cursor(True)
        with suppress(BrokenPipeError):
            os.write(2, f"\n{message}\n".encode() if self.is_terminal else f"{message}\n".encode())

    def print_artifact(self, what: str, path: object) -> None:
        """A line that names a file that is there now."""
        self._rich.print(f"  [green]{escape(what):<12}[/] {escape(str(path))}", highlight=False)

    def warning(self, message: str) -> None:
        """Something the user should know; the same is never said twice."""
        if message in self.warnings:
            return
        if len(self.warnings) == MAX_KEPT_WARNINGS:
            self._discarded_warnings += 1
            return
        self.warnings.append(message)
        if len(self.warnings) <= MAX_PRINTED_WARNINGS:
            self._rich.print(f"[yellow]warning:[/] {escape(message)}", highlight=False)

    def summarize_warnings(self) -> None:
        """Says how many warnings were kept back."""
        rest = len(self.warnings) - MAX_PRINTED_WARNINGS
        if rest > 0:
            beyond = (
                f", and {self._discarded_warnings} that are not" if self._discarded_warnings else ""
            )
            self._rich.print(f"[yellow]warning:[/] … and {rest} more, all in the report{beyond}")

    @contextmanager
    def status(self, message: str) -> Iterator[Callable[[str], None]]:
        """Something that takes a moment: a spinner on a terminal, a line in a log.

        What is yielded says beside the spinner how far it is.
        """
        if not self.is_terminal:
            self.info(message)
            yield lambda _: None
            return
        with self._rich.status(escape(message)) as status:
            yield lambda note: status.update(f"{escape(message)}: {escape(note)}")

    def progress(self, label: str, total: float) -> "ProgressBar":
        """A progress bar; use it in a `with` block. A log gets a line at its beginning."""
        return ProgressBar(self._rich, label, total)


def _min_width_column(width: int) -> Column:
    """A column that keeps this many characters in a narrow terminal."""
    return Column(min_width=width, no_wrap=True)


@final
class ProgressBar:
    """How far something has come: a bar on a terminal, now and then a line in a log."""

    def __init__(self, console: RichConsole, label: str, total: float) -> None:
        """Called by `Console.bar`."""
        self._console, self._label, self._total = console, label, total
        self._progress: Progress | None = None
        self._task = TaskID(0)
        self._started_at = self._logged_at = time.perf_counter()
        self._drawn_at = 0.0

    def __enter__(self) -> "ProgressBar":
        """Shows it."""
        if self._console.is_terminal:
            self._progress = Progress(
                TextColumn(
                    "[bold]{task.description}", table_column=_min_width_column(len(self._label))
                ),
                BarColumn(bar_width=28, table_column=_min_width_column(MIN_BAR_WIDTH)),
                TextColumn("{task.fields[note]}"),
                console=self._console,
                transient=True,
            )
            self._progress.start()
            self._task = self._progress.add_task(self._label, total=self._total, note="")
        else:
            self._console.print(escape(self._label), highlight=False)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Takes it away."""
        if self._progress is not None:
            self._progress.stop()

    def set_count(self, done: int) -> None:
        """This number of the total is done; says how long the rest takes."""
        self.update(float(done), f"{done} of {self._total:.0f}{self._remaining_text(float(done))}")

    def set_share(self, done: float) -> None:
        """This share of the total is done; says how long the rest takes."""
        self.update(done, f"{done / self._total:.0%}{self._remaining_text(done)}")

    def _remaining_text(self, done: float) -> str:
        took = time.perf_counter() - self._started_at
        early = done < MIN_SHARE_FOR_ESTIMATE * self._total or took < MIN_ELAPSED_FOR_ESTIMATE_S
        if early or done >= self._total:
            return ""
        return f", about {format_duration(took * (self._total - done) / done)} left"

    def update(self, done: float, note: str) -> None:
        """So far, and a few words; cheap enough to call at every step."""
        now = time.perf_counter()
        if self._progress is not None:
            if now - self._drawn_at > 0.1:
                self._drawn_at = now
                self._progress.update(self._task, completed=done, note=escape(note))
        elif now - self._logged_at >= LOG_INTERVAL_S:
            self._logged_at = now
            self._console.print(f"{self._label}: {escape(note)}", highlight=False)

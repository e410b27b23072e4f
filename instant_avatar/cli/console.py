"""Console output of a command: a live line on a terminal, plain lines in a log."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import final

from rich.console import Console as RichConsole
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from rich.table import Column

MAX_PRINTED_WARNINGS = 5
"""Warnings, and notes, that are printed; the report lists all of them."""


def format_duration(seconds: float) -> str:
    """Format a duration: "5 s", "40 s", "2 min"; above ten seconds in steps of five."""
    if seconds > 90.0:
        return f"{seconds / 60.0:.0f} min"
    return f"{5 * round(seconds / 5.0) if seconds > 10.0 else max(1, round(seconds))} s"


@final
class StderrConsole(RichConsole):
    """Writes to stderr; goes silent, instead of failing, once its reader closes the pipe."""

    def __init__(self) -> None:
        """Write to stderr without wrapping lines."""
        super().__init__(stderr=True, soft_wrap=True)

    def on_broken_pipe(self) -> None:
        """Go silent; rich would exit."""
        self.quiet = True


@final
class Console:
    """Messages on stderr; stdout is for results.

    Attributes:
        warnings: What asks the user for something.
        notes: What asks for nothing.
    """

    def __init__(self, console: RichConsole | None = None) -> None:
        """Write to stderr, unless another console is given."""
        self._rich = console or StderrConsole()
        self.warnings, self.notes = list[str](), list[str]()

    @property
    def is_terminal(self) -> bool:
        """True if stderr is a terminal."""
        return self._rich.is_terminal

    def info(self, message: str) -> None:
        """Print a line."""
        self._rich.print(escape(message), highlight=False)

    def info_before_exit(self, message: str) -> None:
        """Print a line from a signal handler, and show the terminal's cursor again."""
        self._rich.show_cursor(True)
        with suppress(BrokenPipeError):
            os.write(2, f"\n{message}\n".encode() if self.is_terminal else f"{message}\n".encode())

    def print_artifact(self, what: str, path: object) -> None:
        """Print a line with the path of a written file."""
        self._rich.print(f"  [green]{escape(what):<12}[/] {escape(str(path))}", highlight=False)

    def warning(self, message: str) -> None:
        """Print and keep a warning, once."""
        if self._keep(message, self.warnings):
            self._rich.print(f"[yellow]warning:[/] {escape(message)}", highlight=False)

    def note(self, message: str) -> None:
        """Print and keep a note, once."""
        if self._keep(message, self.notes):
            self.info(message)

    def _keep(self, message: str, messages: list[str]) -> bool:
        """Keep a message unless it is among `messages`; return whether to print it."""
        if message in messages:
            return False
        messages.append(message)
        return len(messages) <= MAX_PRINTED_WARNINGS

    def summarize_warnings(self) -> None:
        """Print how many warnings were not printed."""
        rest = len(self.warnings) - MAX_PRINTED_WARNINGS
        if rest > 0:
            self._rich.print(f"[yellow]warning:[/] … and {rest} more, all in the report")

    @contextmanager
    def status(self, message: str) -> Iterator[None]:
        """Show a spinner (a line in a log) during a block."""
        if not self.is_terminal:
            self.info(message)
            yield
            return
        with self._rich.status(escape(message)):
            yield

    @contextmanager
    def progress(self, label: str, total: float) -> Iterator["ProgressBar"]:
        """Show a progress bar during a block."""
        bar = ProgressBar(self._rich, label, total)
        try:
            yield bar
        finally:
            bar.stop()


def _min_width_column(width: int) -> Column:
    return Column(min_width=width, no_wrap=True)


@final
class ProgressBar:
    """Progress: a bar on a terminal, a line every `LOG_INTERVAL_S` in a log."""

    def __init__(self, console: RichConsole, label: str, total: float) -> None:
        """Show the bar; called by `Console.progress`."""
        self._console, self._label, self._total = console, label, total
        self._progress: Progress | None = None
        self._task = TaskID(0)
        self._started_at = self._logged_at = time.perf_counter()
        self._drawn_at = 0.0
        if not console.is_terminal:
            console.print(escape(label), highlight=False)
            return
        self._progress = Progress(
            TextColumn("[bold]{task.description}", table_column=_min_width_column(len(label))),
            BarColumn(bar_width=28, table_column=_min_width_column(8)),
            TextColumn("{task.fields[note]}"),
            console=console,
            transient=True,
        )
        self._progress.start()
        self._task = self._progress.add_task(label, total=total, note="")

    def stop(self) -> None:
        """Remove the bar."""
        if self._progress is not None:
            self._progress.stop()

    def set_count(self, done: int) -> None:
        """Set the number done of the total, and show the remaining time."""
        self.update(float(done), f"{done} of {self._total:.0f}{self._remaining_text(float(done))}")

    def set_share(self, done: float) -> None:
        """Set the amount done of the total in percent, and show the remaining time."""
        self.update(done, f"{done / self._total:.0%}{self._remaining_text(done)}")

    def _remaining_text(self, done: float) -> str:
        took = time.perf_counter() - self._started_at
        early = done < 0.15 * self._total or took < 2.0
        if early or done >= self._total:
            return ""
        return f", about {format_duration(took * (self._total - done) / done)} left"

    def update(self, done: float, note: str) -> None:
        """Set the amount done and a note; cheap enough to call at every step."""
        now = time.perf_counter()
        if self._progress is not None:
            if now - self._drawn_at > 0.1:
                self._drawn_at = now
                self._progress.update(self._task, completed=done, note=escape(note))
        elif now - self._logged_at >= 10.0:
            self._logged_at = now
            self._console.print(f"{self._label}: {escape(note)}", highlight=False)

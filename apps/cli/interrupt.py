"""Handling of Ctrl-C: the first one requests a stop, the second one quits."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from apps.cli.console import Console

INTERRUPTED = 130
"""Exit code of a command that Ctrl-C ended."""


@contextmanager
def handle_signals(handlers: dict[signal.Signals, Callable[[int, Any], object]]) -> Iterator[None]:
    """Handle signals by functions during a block; they reach the main thread only."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def stop_on_interrupt(
    console: Console, saving_message: str = "saving the checkpoint"
) -> Iterator[threading.Event]:
    """Yield an event that the first Ctrl-C sets; the second raises KeyboardInterrupt.

    On other threads than the main one the event is never set.

    Args:
        console: Shows that the work is stopping.
        saving_message: What happens to the work done.
    """
    stop = threading.Event()

    def first(signal_number: int, frame: object) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        stop.set()
        console.info(f"Stopping; {saving_message}. Press Ctrl-C again to quit immediately.")

    with handle_signals({signal.SIGINT: first}):
        yield stop


@contextmanager
def exit_on_interrupt(
    console: Console, program: str, cleanup: Callable[[], None] = lambda: None
) -> Iterator[None]:
    """Exit the process immediately on Ctrl-C during this block.

    For imports, kernel compilation and native threads, where an exception in the main thread would
    turn into other errors or a crash.

    Args:
        console: Restores the terminal.
        program: Name of the command, in front of the message.
        cleanup: Called before the process exits.
    """

    def leave(signal_number: int, frame: object) -> None:
        cleanup()
        console.info_before_exit(f"{program}: stopped by Ctrl-C.")
        os._exit(INTERRUPTED)

    with handle_signals({signal.SIGINT: leave}):
        yield


@contextmanager
def record_interrupt() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C sets; KeyboardInterrupt is still raised.

    A module being imported may turn the exception into its own error; the event remains set.
    SIGTERM is treated like Ctrl-C. On other threads than the main one the event is never set.
    """
    came = threading.Event()

    def note(signal_number: int, frame: object) -> None:
        came.set()
        raise KeyboardInterrupt

    ends = {signal.SIGINT: note, signal.SIGTERM: lambda *_: signal.raise_signal(signal.SIGINT)}
    with handle_signals(ends):
        yield came


@contextmanager
def interrupt_event() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C sets without raising an exception.

    A KeyboardInterrupt could be swallowed by the callback that it is raised in. On other threads
    than the main one the event is never set.
    """
    ended = threading.Event()
    with handle_signals({signal.SIGINT: lambda *_: ended.set()}):
        yield ended

"""Handling of Ctrl-C: the first one requests a stop, the second one quits."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from apps.cli.console import Console

INTERRUPTED = 130
"""Exit code of a command that Ctrl-C ended."""


@contextmanager
def stop_on_interrupt(
    console: Console, saving_message: str = "saving the checkpoint"
) -> Iterator[threading.Event]:
    """Yield an event that the first Ctrl-C sets; the second raises KeyboardInterrupt.

    Signals reach the main thread only; on other threads the event is never set.

    Args:
        console: Shows that the work is stopping.
        saving_message: What happens to the work done.
    """
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def first(signal_number: int, frame: object) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        stop.set()
        console.info(f"Stopping; {saving_message}. Press Ctrl-C again to quit immediately.")

    before = signal.signal(signal.SIGINT, first)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)


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

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def record_interrupt() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C sets; KeyboardInterrupt is still raised.

    A module being imported may turn the exception into its own error; the event remains set.
    SIGTERM is treated like Ctrl-C. On other threads than the main one the event is never set.
    """
    came = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield came
        return

    def note(signal_number: int, frame: object) -> None:
        came.set()
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, note)
    before_term = signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))
    try:
        yield came
    finally:
        signal.signal(signal.SIGINT, before)
        signal.signal(signal.SIGTERM, before_term)


@contextmanager
def interrupt_event() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C sets without raising an exception.

    A KeyboardInterrupt could be swallowed by the callback that it is raised in. On other threads
    than the main one the event is never set.
    """
    ended = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield ended
        return
    before = signal.signal(signal.SIGINT, lambda *_: ended.set())
    try:
        yield ended
    finally:
        signal.signal(signal.SIGINT, before)

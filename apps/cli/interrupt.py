"""Ctrl-C that lets the work be saved: the first asks to stop, the second stops."""

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
    console: Console, saving_message: str = "what was learnt is being saved"
) -> Iterator[threading.Event]:
    """An event that the first Ctrl-C sets; the second raises KeyboardInterrupt as always.

    Off the main thread, where signals do not arrive, it is never set.

    Args:
        console: Hears that it is stopping.
        kept: What happens to the work done so far.
    """
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def first(signal_number: int, frame: object) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        stop.set()
        console.info(f"Stopping; {saving_message}. Ctrl-C again quits at once.")

    before = signal.signal(signal.SIGINT, first)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def exit_on_interrupt(
    console: Console, program: str, cleanup: Callable[[], None] = lambda: None
) -> Iterator[None]:
    """Ctrl-C ends the process where it stands.

    For the time in which libraries are loaded, kernels compiled and trees searched by threads of
    their own: there an exception in the main thread ends in others, or in a crash.

    Args:
        console: Gives the terminal back.
        program: The command's name, in front of the message.
        tidy: Called before the process ends.
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
    """An event that is set by Ctrl-C, which raises KeyboardInterrupt as always.

    What is being imported may turn that into an error of its own; the event still knows. Off the
    main thread it is never set. SIGTERM, by which machines ask for an end, is taken as Ctrl-C.
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
    """An event that every Ctrl-C sets, and that none of them can miss.

    A KeyboardInterrupt may be raised in a callback that swallows it, and then nothing ends. Off the
    main thread the event is never set.
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

"""Ctrl-C that lets the work be saved: the first asks to stop, the second stops."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from apps.console import Console


@contextmanager
def asked_to_stop(console: Console) -> Iterator[threading.Event]:
    """An event that the first Ctrl-C sets; the second raises KeyboardInterrupt as always.

    Off the main thread, where signals do not arrive, it is never set.
    """
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def first(signal_number: int, frame: object) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        stop.set()
        console.say("Stopping; what was learnt is being saved. Ctrl-C again quits at once.")

    before = signal.signal(signal.SIGINT, first)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)

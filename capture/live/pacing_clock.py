"""A clock whose waits are summed up, and can be ended at once from another thread."""

import threading
import time
from collections.abc import Callable
from typing import final

Clock = Callable[[], float]
Wait = Callable[[float], object]


@final
class PacingClock:
    """The clock of a source whose frames come at times of their own.

    Attributes:
        waited_s: How long it has been waited for frames, in all.
    """

    def __init__(self, *, clock: Clock = time.perf_counter, wait: Wait | None = None) -> None:
        """Start a clock that was not stopped.

        Args:
            clock: Seconds; another one in tests.
            wait: Sleeps for the given seconds, or until the clock is stopped.
        """
        self._ended = threading.Event()
        self._clock = clock
        self._wait: Wait = self._ended.wait if wait is None else wait
        self.waited_s = 0.0

    @property
    def stopped(self) -> bool:
        """Whether `stop` was called: every wait returns at once."""
        return self._ended.is_set()

    def now(self) -> float:
        """Seconds on the clock."""
        return self._clock()

    def stop(self) -> None:
        """Ends every wait, the present one too; from any thread."""
        self._ended.set()

    def wait_until(self, moment: float) -> bool:
        """Waits for a moment on the clock; does not if it has gone by.

        Returns:
            Whether to go on: False after `stop`.
        """
        began = self._clock()
        if moment > began and not self.stopped:
            self._wait(moment - began)
            self.waited_s += self._clock() - began
        return not self.stopped

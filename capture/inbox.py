"""A queue between two threads: one produces items at its own speed, the other takes them."""

import math
import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Generic, TypeVar, final

Item = TypeVar("Item")
POLL_S = 0.1
"""Interval at which one who waits for items looks whether any will come, seconds."""


@final
class Inbox(Generic[Item]):
    """Runs an iterable on a thread of its own and hands its items over, in order.

    When the inbox is full, the producer of a recording waits, so that nothing is lost; for a live
    source the oldest pending item is dropped. An error in the producer is raised in the consumer,
    after the items that came before it.

    Attributes:
        paced: Whether items come at times of their own, so that hurrying would not help.
        live: Whether the producer never waits and older items are dropped for the latest.
        ends_run: Whether nothing is learnt after the last item, however much time is left.
        dropped: Number of items that were dropped for later ones.
    """

    def __init__(
        self,
        items: Iterable[Item],
        *,
        capacity: int = 64,
        paced: bool = False,
        live: bool = False,
        ends_run: bool = False,
        all_came: Callable[[], bool] = lambda: False,
        on_drop: Callable[[Item], object] = lambda item: None,
    ) -> None:
        """Start the producer; at most `capacity` items wait.

        `all_came` tells whether the producer is at its last items; `on_drop` receives what is
        dropped, on the producer's thread.
        """
        self.paced, self.live, self.ends_run = paced, live, ends_run
        self.all_came, self.dropped, self._on_drop = all_came, 0, on_drop
        self._queue: queue.Queue[Item] = queue.Queue(maxsize=capacity)
        self._error: BaseException | None = None
        self._stop = threading.Event()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._fill, args=(items,), daemon=True)
        self._thread.start()

    @property
    def finished(self) -> bool:
        """Return whether everything has been taken and nothing more will come."""
        return self._ended.is_set() and self._queue.empty() and self._error is None

    @property
    def pending(self) -> int:
        """Number of items that have arrived and were not taken."""
        return self._queue.qsize()

    def take(self, *, timeout_s: float = 0.0, max_items: int | None = None) -> list[Item]:
        """Take what has arrived, in order: at most `max_items`, after waiting for a first one."""
        taken: list[Item] = []
        try:
            taken.append(
                self._queue.get(timeout=timeout_s) if timeout_s else self._queue.get_nowait()
            )
            while max_items is None or len(taken) < max_items:
                taken.append(self._queue.get_nowait())
        except queue.Empty:
            pass
        if not taken and self._ended.is_set() and self._error and self._queue.empty():
            error, self._error = self._error, None
            raise error
        return taken

    def items(self, *, max_items: int | None = None) -> Iterator[Item]:
        """Yield items as they come, taken as `take` does, until nothing more will come."""
        while not self.finished:
            yield from self.take(timeout_s=POLL_S, max_items=max_items)

    def close(self, *, timeout_s: float = math.inf) -> None:
        """Tell the producer to stop and wait until it has, but no longer than this."""
        self._stop.set()
        latest = time.perf_counter() + timeout_s
        while self._thread.is_alive() and time.perf_counter() < latest:
            self._drain()
            self._thread.join(timeout=0.02)

    def _drain(self) -> None:
        """Empty the inbox, so that a waiting producer can see that it should stop."""
        while not self._queue.empty():
            try:
                self._queue.get_nowait()
            except queue.Empty:
                return

    def _drop_oldest(self) -> None:
        """Make room for the latest item of a live source; else the producer goes on waiting."""
        if not self.live:
            return
        try:
            oldest = self._queue.get_nowait()
        except queue.Empty:  # the consumer has just taken everything
            return
        self.dropped += 1
        self._on_drop(oldest)

    def _fill(self, items: Iterable[Item]) -> None:
        try:
            for item in items:
                while not self._stop.is_set():
                    try:
                        self._queue.put(item, timeout=0.0 if self.live else 0.1)
                        break
                    except queue.Full:
                        self._drop_oldest()
                if self._stop.is_set():
                    return
        except BaseException as error:
            self._error = error
        finally:
            self._ended.set()

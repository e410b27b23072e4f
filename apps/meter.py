"""Watches a stream go by: how many, how long each took, what was left out, and until when."""

import threading
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar, final

import numpy as np

from apps.report import DroppedNote, Milliseconds
from preprocess.observation import Observation
from preprocess.observe import Dropped

Item = TypeVar("Item")


@final
class Meter:
    """Counts on the producer's thread, read on the consumer's.

    Attributes:
        dropped: Frames that were left out.
        durations_s: How long each frame took, from decoding to ready.
        first_at: When the first frame was ready, on `time.perf_counter`'s clock.
        last_time_s: The newest frame's timestamp.
        size_px: Width and height that training sees.
    """

    def __init__(self, stop: threading.Event) -> None:
        """A meter whose streams end early once `stop` is set."""
        self._stop = stop
        self.dropped: list[DroppedNote] = []
        self.durations_s: list[float] = []
        self.first_at: float | None = None
        self.last_time_s = 0.0
        self.size_px: tuple[int, int] | None = None

    def watched(
        self, observations: Iterable[Observation | Dropped]
    ) -> Iterator[Observation | Dropped]:
        """Passes observations on and notes what they say."""
        for item in observations:
            if isinstance(item, Dropped):
                self.dropped.append(DroppedNote(index=item.index, reason=item.reason))
            else:
                self.last_time_s = item.frame.time_s
                self.size_px = item.camera.size_px
            yield item

    def timed(self, items: Iterator[Item]) -> Iterator[Item]:
        """Passes items on, noting how long each took to come, until `stop` is set."""
        while not self._stop.is_set():
            started = time.perf_counter()
            try:
                item = next(items)
            except StopIteration:
                return
            now = time.perf_counter()
            self.durations_s.append(now - started)
            if self.first_at is None:
                self.first_at = now
            yield item

    def ingest_ms(self) -> Milliseconds:
        """How long a frame took."""
        durations = np.array(self.durations_s or [0.0]) * 1000.0
        return Milliseconds(
            p50=float(np.percentile(durations, 50)), p95=float(np.percentile(durations, 95))
        )

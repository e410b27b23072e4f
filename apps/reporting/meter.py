"""Watches a stream go by: how many, how long each took, what was left out, and until when."""

import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator
from typing import TypeVar, final

from apps.reporting.report import DroppedNote, Spread, StreamNote
from avatar.hold import PassedOver
from capture.frame import Frame
from capture.reservoir import Reservoir
from capture.source import Source
from preprocess.observation import Observation
from preprocess.observe import Dropped

Item = TypeVar("Item")

MOST_NOTES = 1000
"""Frames that were left out and are listed; of the others only the number is kept."""


@final
class Meter:
    """Counts on the producer's thread, read on the consumer's.

    Attributes:
        read: Frames that came out of the source.
        dropped: Those that were left out, the first `MOST_NOTES` of them.
        dropped_count: How many were left out.
        passed_over: How many are not learnt from because they look like the one before.
        held_out: How many the trainer got that are not learnt from.
        first_at: When the first frame was there, on `time.perf_counter`'s clock.
        last_s: The newest frame's time, counted from the first frame's.
        size_px: Width and height that training sees.
        prepared_s: How long frames took, from decoding to ready, without waiting for them.
        lateness_s: How long after its moment each frame was handed over to be prepared.
        latency_s: From the moment a frame was there until the trainer had it.
        behind_s: The latest of these.
        depth: How many frames waited in the inbox, looked at after each step.
        inbox_dropped: How many gave way in the inbox.
    """

    def __init__(self, stop: threading.Event, source: Source) -> None:
        """A meter whose streams end early once `stop` is set."""
        self._stop, self._source = stop, source
        self.read = self.dropped_count = self.passed_over = self.held_out = 0
        self.dropped: list[DroppedNote] = []
        self.first_at: float | None = None
        self.last_s = 0.0
        self.size_px: tuple[int, int] | None = None
        self.prepared_s, self.lateness_s = Reservoir(), Reservoir()
        self.latency_s, self.depth = Reservoir(), Reservoir()
        self.behind_s = 0.0
        self.inbox_dropped = 0
        self._first_time_s = self._began_at = 0.0
        self._there_at: deque[tuple[int, float]] = deque()

    def frames(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Passes frames on and notes when they were there."""
        for frame in frames:
            now = time.perf_counter()
            there_at = now if frame.due_s is None else frame.due_s
            self.lateness_s.add(now - there_at)
            if self.first_at is None:
                self.first_at, self._first_time_s = there_at, frame.time_s
                self._began_at = there_at
            self.last_s = max(self.last_s, frame.time_s - self._first_time_s)
            if frame.due_s is not None:  # a resumed run plays from where it had come to
                self._began_at = there_at - (frame.time_s - self._first_time_s)
            self.read += 1
            self._there_at.append((frame.index, there_at))
            yield frame

    def watched(
        self, observations: Iterable[Observation | Dropped]
    ) -> Iterator[Observation | Dropped]:
        """Passes observations on and notes what they say."""
        for item in observations:
            if isinstance(item, Dropped):
                self.dropped_count += 1
                if len(self.dropped) < MOST_NOTES:
                    self.dropped.append(DroppedNote(index=item.index, reason=item.reason))
            else:
                self.size_px = item.camera.size_px
            yield item

    def timed(self, items: Iterator[Item]) -> Iterator[Item]:
        """Passes items on, noting how long each took to make, until `stop` is set."""
        while not self._stop.is_set():
            started, waited = time.perf_counter(), self._source.waited_s
            try:
                item = next(items)
            except StopIteration:
                return
            waited = self._source.waited_s - waited
            if isinstance(item, PassedOver):
                self.passed_over += 1
            else:
                self.prepared_s.add(time.perf_counter() - started - waited)
            yield item

    def arrived(self, index: int, *, held_out: bool) -> None:
        """The trainer has a frame now; those before it that it never got are forgotten."""
        self.held_out += held_out
        while self._there_at and self._there_at[0][0] <= index:
            number, there_at = self._there_at.popleft()
            if number == index:
                self.behind_s = time.perf_counter() - there_at
                self.latency_s.add(self.behind_s)

    def note(self, *, ready_at: float | None) -> StreamNote:
        """What the report says of the stream.

        Args:
            ready_at: When the package was there, on `time.perf_counter`'s clock.
        """
        ready = None
        if ready_at is not None and self.first_at is not None:
            ready = ready_at - (self._began_at + self.last_s)
        return StreamNote(
            realtime=self._source.paced,
            ingest_ms=Spread.of(self.prepared_s, scale=1000.0),
            inbox_dropped=self.inbox_dropped + self._source.dropped,
            ready_after_last_frame_seconds=ready,
            latency_ms=Spread.of(self.latency_s, scale=1000.0),
            lateness_ms=Spread.of(self.lateness_s, scale=1000.0),
            inbox_depth=Spread.of(self.depth),
        )

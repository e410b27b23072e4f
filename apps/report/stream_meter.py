"""Watches a stream go by: how many, how long each took, what was left out, and until when."""

import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator
from typing import TypeVar, final

from apps.report.report_schema import DroppedFrameEntry, Percentiles, StreamStats
from avatar.training.frame_stream import RedundantFrame
from capture.frame import Frame
from capture.process_metrics import ReservoirSample
from capture.source import FrameSource
from preprocess.observation import Observation
from preprocess.observe import DroppedFrame

Item = TypeVar("Item")

MAX_DROPPED_LISTED = 1000
"""Frames that were left out and are listed; of the others only the number is kept."""


@final
class StreamMeter:
    """Counts on the producer's thread, read on the consumer's.

    Attributes:
        read: Frames that came out of the source.
        dropped: Those that were left out, the first `MAX_DROPPED_LISTED` of them.
        dropped_count: How many were left out.
        near_duplicates: How many are not learnt from because they look like the one before.
        held_out: How many the trainer got that are not learnt from.
        first_frame_at: When the first frame was there, on `time.perf_counter`'s clock.
        last_s: The newest frame's time, counted from the first frame's.
        size_px: Width and height that training sees.
        preparation_s: How long frames took, from decoding to ready, without waiting for them.
        lateness_s: How long after its moment each frame was handed over to be prepared.
        latency_s: From the moment a frame was there until the trainer had it.
        current_latency_s: The latest of these.
        depth: How many frames waited in the inbox, looked at after each step.
        inbox_dropped: How many gave way in the inbox.
    """

    def __init__(self, stop: threading.Event, source: FrameSource) -> None:
        """A meter whose streams end early once `stop` is set."""
        self._stop, self._source = stop, source
        self.frames_read = self.dropped_count = self.near_duplicates = self.held_out_count = 0
        self.dropped: list[DroppedFrameEntry] = []
        self.first_frame_at: float | None = None
        self.last_frame_s = 0.0
        self.size_px: tuple[int, int] | None = None
        self.preparation_s, self.lateness_s = ReservoirSample(), ReservoirSample()
        self.latency_s, self.inbox_depth = ReservoirSample(), ReservoirSample()
        self.current_latency_s = 0.0
        self.inbox_dropped = 0
        self._first_time_s = self._clip_started_at = 0.0
        self._available_at: deque[tuple[int, float]] = deque()

    def measure_arrival(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Passes frames on and notes when they were there."""
        for frame in frames:
            now = time.perf_counter()
            there_at = now if frame.due_s is None else frame.due_s
            self.lateness_s.add(now - there_at)
            if self.first_frame_at is None:
                self.first_frame_at, self._first_time_s = there_at, frame.time_s
                self._clip_started_at = there_at
            self.last_frame_s = max(self.last_frame_s, frame.time_s - self._first_time_s)
            if frame.due_s is not None:  # a resumed run plays from where it had come to
                self._clip_started_at = there_at - (frame.time_s - self._first_time_s)
            self.frames_read += 1
            self._available_at.append((frame.index, there_at))
            yield frame

    def count_observations(
        self, observations: Iterable[Observation | DroppedFrame]
    ) -> Iterator[Observation | DroppedFrame]:
        """Passes observations on and notes what they say."""
        for item in observations:
            if isinstance(item, DroppedFrame):
                self.dropped_count += 1
                if len(self.dropped) < MAX_DROPPED_LISTED:
                    self.dropped.append(DroppedFrameEntry(index=item.index, reason=item.reason))
            else:
                self.size_px = item.camera.size_px
            yield item

    def measure_preparation(self, items: Iterator[Item]) -> Iterator[Item]:
        """Passes items on, noting how long each took to make, until `stop` is set."""
        while not self._stop.is_set():
            started, waited = time.perf_counter(), self._source.waited_s
            try:
                item = next(items)
            except StopIteration:
                return
            waited = self._source.waited_s - waited
            if isinstance(item, RedundantFrame):
                self.near_duplicates += 1
            else:
                self.preparation_s.add(time.perf_counter() - started - waited)
            yield item

    def mark_arrived(self, index: int, *, held_out: bool) -> None:
        """The trainer has a frame now; those before it that it never got are forgotten."""
        self.held_out_count += held_out
        while self._available_at and self._available_at[0][0] <= index:
            number, there_at = self._available_at.popleft()
            if number == index:
                self.current_latency_s = time.perf_counter() - there_at
                self.latency_s.add(self.current_latency_s)

    def stats(self, *, ready_at: float | None) -> StreamStats:
        """What the report says of the stream.

        Args:
            ready_at: When the package was there, on `time.perf_counter`'s clock.
        """
        ready = None
        if ready_at is not None and self.first_frame_at is not None:
            ready = ready_at - (self._clip_started_at + self.last_frame_s)
        return StreamStats(
            realtime=self._source.paced,
            ingest_ms=Percentiles.of(self.preparation_s, scale=1000.0),
            inbox_dropped=self.inbox_dropped + self._source.dropped,
            ready_after_last_frame_seconds=ready,
            latency_ms=Percentiles.of(self.latency_s, scale=1000.0),
            lateness_ms=Percentiles.of(self.lateness_s, scale=1000.0),
            inbox_depth=Percentiles.of(self.inbox_depth),
        )

"""Flow of a run's frame stream: counts, and how far behind its source training is."""

import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator
from typing import TypeVar, final

from avatar.training.frame_stream import RedundantFrame
from capture.input_error import counted
from capture.source import Frame, FrameSource
from instant_avatar.report.report_schema import Percentiles, StreamStats
from preprocess.observation import DroppedFrame, Observation

Item = TypeVar("Item")

MAX_DROPPED_LISTED = 1000
"""Dropped frames that are listed with their reasons; the rest are only counted."""


@final
class StreamMeter:
    """Counts frames on the producer's thread; read on the consumer's.

    Attributes:
        dropped: The first `MAX_DROPPED_LISTED` dropped frames.
        near_duplicates: Frames not trained on because they resemble the previous one.
        held_out_count: Held-out frames that have reached the trainer.
        first_frame_at: When the first frame was available, on `time.perf_counter`'s clock.
        last_frame_s: Time of the newest frame since the first one, in the video.
        size_px: Width and height of training images.
        preparation_s: From decoding to ready for training, without waiting for the source.
        lateness_s: From the moment a frame was due until its preparation began.
        latency_s: From the moment a frame was available until the trainer had it.
        inbox_depth: Frames waiting in the inbox, sampled after each step.
        inbox_dropped: Frames that the inbox replaced by newer ones.
    """

    def __init__(self, stop: threading.Event, source: FrameSource) -> None:
        """Measure one source; `measure_preparation` ends early once `stop` is set."""
        self._stop, self._source = stop, source
        self.frames_read = self.dropped_count = self.near_duplicates = self.held_out_count = 0
        self.dropped: list[DroppedFrame] = []
        self.first_frame_at: float | None = None
        self.last_frame_s = 0.0
        self.size_px: tuple[int, int] | None = None
        self.preparation_s, self.lateness_s = list[float](), list[float]()
        self.latency_s, self.inbox_depth = list[float](), list[float]()
        self.current_latency_s = 0.0
        self.inbox_dropped = 0
        self._first_time_s = self._clip_started_at = 0.0
        self._available_at: deque[tuple[int, float]] = deque()

    @property
    def grows(self) -> bool:
        """True if frames are files that another program writes: the run ends with them."""
        return self._source.frame_count is None and not self._source.live

    @property
    def is_paced(self) -> bool:
        """True if frames come at their own times, which may be faster than training takes them."""
        return self._source.paced

    def measure_arrival(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Pass frames on and record when each was available."""
        for frame in frames:
            now = time.perf_counter()
            available_at = now if frame.due_s is None else frame.due_s
            self.lateness_s.append(now - available_at)
            if self.first_frame_at is None:
                self.first_frame_at, self._first_time_s = available_at, frame.time_s
                self._clip_started_at = available_at
            self.last_frame_s = max(self.last_frame_s, frame.time_s - self._first_time_s)
            if frame.due_s is not None:  # a resumed run plays on from its last frame
                self._clip_started_at = available_at - (frame.time_s - self._first_time_s)
            self.frames_read += 1
            self._available_at.append((frame.index, available_at))
            yield frame

    def count_observations(
        self, observations: Iterable[Observation | DroppedFrame]
    ) -> Iterator[Observation | DroppedFrame]:
        """Pass observations on; count dropped frames and record the image size."""
        for item in observations:
            if isinstance(item, DroppedFrame):
                self.dropped_count += 1
                if len(self.dropped) < MAX_DROPPED_LISTED:
                    self.dropped.append(item)
            else:
                self.size_px = item.camera.size_px
            yield item

    def measure_preparation(self, items: Iterator[Item]) -> Iterator[Item]:
        """Pass items on until `stop` is set; record how long each took to prepare."""
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
                self.preparation_s.append(time.perf_counter() - started - waited)
            yield item

    def mark_arrived(self, index: int, *, held_out: bool) -> None:
        """Record that the trainer has a frame; forget older ones that it never got."""
        self.held_out_count += held_out
        while self._available_at and self._available_at[0][0] <= index:
            number, available_at = self._available_at.popleft()
            if number == index:
                self.current_latency_s = time.perf_counter() - available_at
                self.latency_s.append(self.current_latency_s)

    def lateness_warnings(self) -> Iterator[str]:
        """Yield warnings about frames that could not be prepared as fast as they came."""
        dropped = self._source.dropped + self.inbox_dropped
        late = Percentiles.of(self.lateness_s)
        if dropped:
            yield (
                f"Dropped: {counted(dropped, 'frame')}, because tracking or preprocessing is "
                "slower than the frame rate. The others are enough if the person moves slowly; "
                "else reduce --size."
            )
        is_playback = self._source.paced and self._source.frame_count is not None
        is_playback = is_playback and not self._source.skippable
        if is_playback and not dropped and late.p95 > 0.5:
            yield (
                f"Playback lagged by up to {max(self.lateness_s):.1f} s (median {late.p50:.1f} s): "
                "preprocessing is slower than the frame rate. No frame was dropped. Reduce --size, "
                "or use every other frame (--frames ::2)."
            )

    def stats(self, *, ready_at: float | None) -> StreamStats:
        """Summarize the stream; the package was ready at `ready_at` of `perf_counter`'s clock."""
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

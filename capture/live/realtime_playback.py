"""Frames at times of their own: the clock of their source, and a recording that is played."""

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import final

from capture.frame import Frame
from capture.source import FrameSource

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


@final
class RealtimePlayback:
    """A source whose frames are handed over no earlier than their timestamps say.

    The first frame is at 0; what lies between two frames is what the container says, whatever its
    rate. Nothing is lost: where frames are not taken in time, the playback falls behind and
    catches up as soon as it can.

    Attributes:
        catch_up: Whether frames come as fast as they are taken, as those do that an interrupted run
            has seen before. Where it ends, the video plays on from there at its own speed.
    """

    live = False
    paced = True

    def __init__(self, source: FrameSource, pace: PacingClock) -> None:
        """Nothing is read yet.

        Args:
            source: What is played.
            pace: Its clock; ending it ends the playback, also in the middle of a wait.
        """
        self._source, self._pace = source, pace
        self.catch_up = False
        self.path = source.path
        self.size_px = source.size_px
        self.selection = source.selection
        self.frames_in_file = source.frames_in_file
        self.frame_count = source.frame_count
        self.duration_s = source.duration_s
        self.has_alpha = source.has_alpha
        self.quarter_turns = source.quarter_turns
        self.started_at = source.started_at
        self.warnings = source.warnings

    @property
    def waited_s(self) -> float:
        """How long frames have been held back in all."""
        return self._pace.waited_s

    @property
    def dropped(self) -> int:
        """How many frames were lost: none."""
        return self._source.dropped

    def frames(self) -> Iterator[Frame]:
        """The frames when they are due, read one ahead; every call plays from the start."""
        began = due = None
        for frame in self._source.frames():
            if began is None or due is None or self.catch_up:
                due = self._pace.now()
                began = due - frame.time_s
            due = max(due, began + frame.time_s)
            if not self._pace.wait_until(due):
                return
            yield replace(frame, due_s=due)

    def count_frames(self) -> int:
        """As the recording's own."""
        return self._source.count_frames()

    def close(self) -> None:
        """Ends the playback, also in the middle of a wait."""
        self._pace.stop()
        self._source.close()

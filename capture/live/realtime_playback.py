"""A recording played as a live capture: each frame comes at its own time."""

from collections.abc import Iterator
from dataclasses import replace
from typing import final

from capture.frame import Frame
from capture.live.pacing_clock import PacingClock
from capture.source import FrameSource


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

"""A recording whose width and height are exchanged in name only."""

from collections.abc import Iterator
from typing import final

from capture.frame import Frame
from capture.source import FrameSource


@final
class TransposedSource:
    """A source that is said to be as high as it is wide, and as wide as it is high.

    With it masks and cameras of the upright pictures can be opened for a film that was rotated by
    a quarter turn afterwards. The frames themselves stay as they are.
    """

    live = False
    paced = False
    waited_s = 0.0

    def __init__(self, source: FrameSource) -> None:
        """Nothing is read yet.

        Args:
            source: A recording.
        """
        self._source = source
        self.path = source.path
        self.size_px = (source.size_px[1], source.size_px[0])
        self.selection = source.selection
        self.frames_in_file = source.frames_in_file
        self.frame_count = source.frame_count
        self.duration_s = source.duration_s
        self.has_alpha = source.has_alpha
        self.quarter_turns = source.quarter_turns
        self.started_at = source.started_at
        self.dropped = source.dropped
        self.warnings = source.warnings

    def frames(self) -> Iterator[Frame]:
        """The recording's frames, of its own size."""
        return self._source.frames()

    def count_frames(self) -> int:
        """How many frames there really are in all, found by decoding."""
        return self._source.count_frames()

    def close(self) -> None:
        """Closes the recording."""
        self._source.close()

"""Sources of observations: a recording's, at once or at its own speed, or a tracked stream's."""

from collections.abc import Iterator
from typing import final

from capture.source import Frame, FrameSource, PacingClock, RealtimePlayback
from preprocess.body.body_pose import BodyPose
from preprocess.capture_session import Capture
from preprocess.observation import DroppedFrame, Observation


class ObservationSource:
    """Where a training session gets its observations from.

    Attributes:
        capture: What the frames are joined with, and where that comes from.
        frames: The frames, as they are delivered.
    """

    def __init__(self, capture: Capture, frames: FrameSource) -> None:
        """Read nothing yet."""
        self.capture, self.frames = capture, frames

    def join(self, frame: Frame) -> Observation | DroppedFrame:
        """Join the next frame with its pose, mask and camera."""
        raise NotImplementedError

    def set_catch_up(self, catch_up: bool) -> None:
        """Deliver frames without delay while a resumed run reads back what it has seen."""

    def take_revised_poses(self) -> dict[int, BodyPose]:
        """Poses of earlier frames that later ones have improved since the last call."""
        return {}

    def notes(self) -> Iterator[str]:
        """Messages for the user that need the frames to have come."""
        yield from self.capture.masks.notes()


@final
class RecordedObservations(ObservationSource):
    """The observations of a recording; with `realtime` each frame comes at its own time."""

    def __init__(self, capture: Capture, *, realtime: bool = False) -> None:
        """Read nothing yet; an InputError if the capture's parts do not fit together."""
        self._playback = RealtimePlayback(capture.source, PacingClock())
        super().__init__(capture, self._playback if realtime else capture.source)
        self._join = capture.observation_builder()

    def join(self, frame: Frame) -> Observation | DroppedFrame:
        """Join a frame with its pose, mask and camera."""
        return self._join(frame)

    def set_catch_up(self, catch_up: bool) -> None:
        """Play without delay for a while."""
        self._playback.catch_up = catch_up

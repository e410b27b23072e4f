"""Sources of observations: a recording's, at once or at its own speed, or a tracked stream's."""

from collections.abc import Iterator
from typing import Protocol, final, runtime_checkable

from capture.source import Frame, FrameSource, PacingClock, RealtimePlayback
from preprocess.body.body_pose import BodyPose
from preprocess.capture_session import Capture
from preprocess.observation import DroppedFrame, Observation


@runtime_checkable
class ObservationSource(Protocol):
    """Where a training session gets its observations from.

    Attributes:
        capture: What the frames are joined with, and where that comes from.
        frames: The frames, as they are delivered.
    """

    capture: Capture
    frames: FrameSource

    def join(self, frame: Frame, /) -> Observation | DroppedFrame:
        """Join the next frame with its pose, mask and camera."""
        ...

    def set_catch_up(self, catch_up: bool) -> None:
        """Deliver frames without delay while a resumed run reads back what it has seen."""
        ...

    def take_revised_poses(self) -> dict[int, BodyPose]:
        """Poses of earlier frames that later ones have improved since the last call."""
        ...

    def notes(self) -> Iterator[str]:
        """Messages for the user that need the frames to have come."""
        ...


@final
class RecordedObservations:
    """The observations of a recording with poses, cameras and masks."""

    def __init__(self, capture: Capture, *, realtime: bool = False) -> None:
        """Read nothing yet; with `realtime` each frame comes at its own time."""
        self.capture, self.join = capture, capture.observation_builder()
        self._playback = RealtimePlayback(capture.source, PacingClock())
        self.frames: FrameSource = self._playback if realtime else capture.source

    def set_catch_up(self, catch_up: bool) -> None:
        """Play without delay for a while."""
        self._playback.catch_up = catch_up

    def take_revised_poses(self) -> dict[int, BodyPose]:
        """None are revised."""
        return {}

    def notes(self) -> Iterator[str]:
        """What the masks have to say."""
        yield from self.capture.masks.notes()

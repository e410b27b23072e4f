"""The interface of every source of frames, recorded or live, and the selection of its frames."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, final, runtime_checkable

from capture.frame import Frame
from capture.input_error import InputError


@dataclass(frozen=True, kw_only=True)
class FrameSelection:
    """Every `step`-th frame from `start` up to, not including, `stop` (None: to the end)."""

    start: int = 0
    stop: int | None = None
    step: int = 1

    @classmethod
    def of(cls, frames: slice | None) -> "FrameSelection":
        """From a slice; all frames if it is None.

        Raises:
            InputError: If it counts from the end, goes backwards or leaves nothing.
        """
        if frames is None:
            return cls()
        start = 0 if frames.start is None else frames.start
        step = 1 if frames.step is None else frames.step
        if start < 0 or step < 1 or (frames.stop is not None and frames.stop <= start):
            raise InputError(
                f"Frames {start}:{'' if frames.stop is None else frames.stop}:{step} name nothing; "
                "expected START:STOP:STEP with 0 <= START < STOP and STEP >= 1."
            )
        return cls(start=start, stop=frames.stop, step=step)

    def contains(self, index: int) -> bool:
        """Whether the frame with this number belongs to it."""
        return (
            index >= self.start
            and not self.is_past_end(index)
            and not (index - self.start) % self.step
        )

    def is_past_end(self, index: int) -> bool:
        """Whether no frame from this number on belongs to it."""
        return self.stop is not None and index >= self.stop

    def count(self, total: int) -> int:
        """How many of `total` frames belong to it."""
        return len(range(self.start, min(total, self.stop or total), self.step))

    def position(self, index: int) -> int:
        """The place of a wanted frame among the wanted ones, counted from 0."""
        return (index - self.start) // self.step

    def span(self, total: int) -> int:
        """How many of `total` frames lie from the first wanted one to the last, both counted."""
        count = self.count(total)
        return (count - 1) * self.step + 1 if count else 0


@runtime_checkable
class FrameSource(Protocol):
    """A recorded or live stream of upright RGB frames of one size.

    Attributes:
        path: The video file or the folder of pictures itself.
        size_px: Width and height of every frame.
        selection: The frames that are wanted.
        frames_in_file: How many frames there are in all, wanted or not, as the container claims;
            of a live source 0.
        frame_count: Number of selected frames; fewer may come, see `warnings`. None for a live
            source.
        duration_s: How long the wanted frames last, as the container claims; None if unknown.
        has_alpha: Whether the frames' own alpha channel is their mask: it cuts the person out of
            one of the pictures that were looked at, and no segmenter was asked for instead.
        quarter_turns: Counter-clockwise quarter turns that make stored images upright.
        live: Whether frames that are not taken in time are lost.
        paced: Whether frames come at times of their own, however fast they are taken.
        waited_s: How long `frames()` has waited for frames, in all.
        dropped: Number of frames that were lost because they were not taken in time.
        started_at: When the first frame of a live source was filmed, in seconds since 1970.
        warnings: What was wrong so far; grows while `frames()` is read.
    """

    path: Path
    size_px: tuple[int, int]
    selection: FrameSelection
    frames_in_file: int
    frame_count: int | None
    duration_s: float | None
    has_alpha: bool
    quarter_turns: int
    live: bool
    paced: bool
    started_at: float
    warnings: list[str]

    @property
    def waited_s(self) -> float:
        """How long `frames()` has waited for frames, in all."""
        ...

    @property
    def dropped(self) -> int:
        """Number of frames that were lost because they were not taken in time."""
        ...

    def frames(self) -> Iterator[Frame]:
        """The frames, lazily and in order; every call starts from the first."""
        ...

    def count_frames(self) -> int:
        """How many frames there really are in all, found by decoding; slow."""
        ...

    def close(self) -> None:
        """Ends `frames()`, also one that waits on another thread, and lets a device go."""
        ...


@final
class TransposedSource:
    """A recording that reports its width as its height and its height as its width.

    With it masks and cameras of upright images can be opened for a video that was rotated by a
    quarter turn afterwards. The frames themselves are unchanged.
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

"""Frames and the interface of their sources; a recording transposed, or played in real time."""

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import final

import numpy as np
from jaxtyping import Float32, UInt8

from capture.input_error import InputError

RgbImage = UInt8[np.ndarray, "height width 3"]
"""Colors of an image, from 0 to 255."""
AlphaMask = Float32[np.ndarray, "height width"]
"""Opacity of the person at each pixel, in [0, 1]."""
ASSUMED_FPS = 30.0
"""Frames or poses per second where no file says: folders of images, poses without times."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Frame:
    """An upright RGB image and its place in the stream.

    Attributes:
        index: Position in the source, counted from 0 (frames that were skipped keep their number).
        time_s: Container timestamp in seconds; never computed from an assumed rate.
        flags: What is wrong with it: "corrupt", or nothing.
        alpha: The source's own alpha channel (RGBA images), else None.
        due_s: Time on `time.perf_counter`'s clock at which it was played or filmed. None for a
            recording that is read as fast as it is taken.
    """

    index: int
    time_s: float
    rgb: RgbImage
    flags: frozenset[str] = frozenset()
    alpha: UInt8[np.ndarray, "height width"] | None = None
    due_s: float | None = None

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.rgb.shape[1], self.rgb.shape[0]

    def turn(self, degrees: int) -> "Frame":
        """The frame turned clockwise by a multiple of 90 degrees."""
        rgb, alpha = np.rot90(self.rgb, -degrees // 90), self.alpha
        if alpha is not None:
            alpha = np.ascontiguousarray(np.rot90(alpha, -degrees // 90))
        return replace(self, rgb=np.ascontiguousarray(rgb), alpha=alpha)


def shrink_to_longer_side(size_px: tuple[int, int], longer_px: int | None) -> tuple[int, int]:
    """Width and height with the longer side shrunk to `longer_px`; never enlarged."""
    if longer_px is None or longer_px >= max(size_px):
        return size_px
    scale = longer_px / max(size_px)
    return max(1, round(size_px[0] * scale)), max(1, round(size_px[1] * scale))


@dataclass(frozen=True, kw_only=True)
class FrameSelection:
    """Every `step`-th frame from `start` up to, not including, `stop` (None: to the end)."""

    start: int = 0
    stop: int | None = None
    step: int = 1

    @classmethod
    def of(cls, frames: slice | None) -> "FrameSelection":
        """The selection of a slice; all frames if it is None."""
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
        """Return whether the frame with this number is selected."""
        return (
            index >= self.start
            and not self.is_past_end(index)
            and not (index - self.start) % self.step
        )

    def is_past_end(self, index: int) -> bool:
        """Return whether no frame from this number on is selected."""
        return self.stop is not None and index >= self.stop

    def count(self, total: int) -> int:
        """Number of selected frames of `total`."""
        return len(range(self.start, min(total, self.stop or total), self.step))

    def position(self, index: int) -> int:
        """The place of a selected frame among the selected ones, counted from 0."""
        return (index - self.start) // self.step

    def span(self, total: int) -> int:
        """Number of frames of `total` from the first selected one to the last, both counted."""
        count = self.count(total)
        return (count - 1) * self.step + 1 if count else 0


@final
class PacingClock:
    """The clock of a source whose frames come at times of their own.

    `waited_s` sums up the seconds of all waits.
    """

    def __init__(
        self,
        *,
        clock: Callable[[], float] = time.perf_counter,
        wait: Callable[[float], object] | None = None,
    ) -> None:
        """Start a clock of seconds; `wait` sleeps for some, or until the clock is stopped."""
        self._ended = threading.Event()
        self._clock = clock
        self._wait: Callable[[float], object] = self._ended.wait if wait is None else wait
        self.waited_s = 0.0

    def __reduce__(self) -> tuple[type["PacingClock"], tuple[()]]:
        """Start another process's own clock."""
        return PacingClock, ()

    @property
    def stopped(self) -> bool:
        """Return whether `stop` was called: every wait returns at once."""
        return self._ended.is_set()

    def now(self) -> float:
        """Seconds on the clock."""
        return self._clock()

    def stop(self) -> None:
        """End every wait, the present one too; from any thread."""
        self._ended.set()

    def wait_until(self, moment: float) -> bool:
        """Wait for a moment on the clock, unless it has gone by; return False after `stop`."""
        began = self._clock()
        if moment > began and not self.stopped:
            self._wait(moment - began)
            self.waited_s += self._clock() - began
        return not self.stopped


class FrameSource:
    """A recorded or live stream of upright RGB frames of one size.

    Attributes:
        path: The video file or the folder of images itself.
        frames_in_file: Number of all frames, selected or not, as the container claims; of a live
            source 0.
        frame_count: Number of selected frames; fewer may come, see `warnings`. None for a live
            source.
        duration_s: Duration of the selected frames, as the container claims; None if unknown.
        has_alpha: Whether the frames' own alpha channel cuts the person out of one of the sampled
            images.
        rotate: Degrees by which the user had upright frames turned clockwise.
        is_hdr: Whether frames are tone mapped from HDR.
        live: Whether frames that are not taken in time are lost.
        paced: Whether frames come at times of their own, however fast they are taken.
        skippable: Whether a newer frame may replace one that was not taken in time, as both are
            filmed at this moment.
        all_came: Whether every frame has come, and only such as were skipped are still to be taken.
        started_at: Time when the first frame of a live source was filmed, seconds since 1970.
        warnings: Problems so far; grows while `frames()` is read.
    """

    size_px: tuple[int, int]
    frames_in_file: int = 0
    frame_count: int | None = None
    duration_s: float | None = None
    has_alpha: bool = False
    is_hdr: bool = False
    live: bool = False
    paced: bool = False
    skippable: bool = False
    all_came: bool = False
    rotate: int = 0
    started_at: float = 0.0

    def __init__(
        self, path: Path, selection: FrameSelection, pace: PacingClock | None = None
    ) -> None:
        """Keep the arguments; nothing is read yet. Stopping the clock `pace` ends every wait."""
        self.path, self.selection, self._pace = path, selection, pace or PacingClock()
        self.warnings: list[str] = []

    @property
    def waited_s(self) -> float:
        """Seconds that `frames()` has waited for frames, in all."""
        return self._pace.waited_s

    @property
    def dropped(self) -> int:
        """Number of frames that were lost because they were not taken in time."""
        return 0

    def frames(self) -> Iterator[Frame]:
        """The selected frames, lazily and in order; every call starts from the first."""
        raise NotImplementedError

    def count_frames(self) -> int:
        """The true number of all frames, found by decoding, which is slow; 0 if it is unknown."""
        return 0

    def close(self) -> None:
        """End `frames()`, also one that waits on another thread, and release a device."""
        self._pace.stop()

    def _is_of_size(self, name: str, rgb: RgbImage) -> bool:
        """Return whether an image has the size of the first one; warn if not."""
        height, width = rgb.shape[:2]
        if (width, height) != self.size_px:
            self._warn(
                f"{name} has {width}x{height} px, the first picture "
                f"{self.size_px[0]}x{self.size_px[1]}. It was left out."
            )
        return (width, height) == self.size_px

    def _warn(self, message: str) -> None:
        if message not in self.warnings and len(self.warnings) < 100:
            self.warnings.append(message)


class WrappedSource(FrameSource):
    """A source of which something is changed; all else is the source's own."""

    def __init__(self, source: FrameSource) -> None:
        """Wrap a source; nothing is read yet."""
        super().__init__(source.path, source.selection, source._pace)
        self._source = source
        for name in FrameSource.__annotations__:
            setattr(self, name, getattr(source, name))
        self.warnings = source.warnings

    @property
    def dropped(self) -> int:
        """The source's own."""
        return self._source.dropped

    def frames(self) -> Iterator[Frame]:
        """The source's frames."""
        return self._source.frames()

    def count_frames(self) -> int:
        """The source's true number of frames, found by decoding."""
        return self._source.count_frames()

    def close(self) -> None:
        """Close the source."""
        super().close()
        self._source.close()


@final
class RotatedSource(WrappedSource):
    """A source whose frames are turned clockwise by 90, 180 or 270 degrees."""

    def __init__(self, source: FrameSource, degrees: int) -> None:
        """Wrap a source; nothing is read yet."""
        super().__init__(source)
        self.rotate = degrees
        if degrees % 180:
            self.size_px = (source.size_px[1], source.size_px[0])

    def frames(self) -> Iterator[Frame]:
        """The frames, turned."""
        for frame in self._source.frames():
            yield frame.turn(self.rotate)


@final
class RealtimePlayback(WrappedSource):
    """A source whose frames are handed over no earlier than their timestamps say.

    The first frame is at 0; the intervals between frames are the container's, whatever its rate.
    Nothing is lost: where frames are not taken in time, the playback falls behind and catches up as
    soon as it can. While `catch_up` is set, frames come as fast as they are taken; where it ends,
    the video plays on from there at its own speed.
    """

    def __init__(self, source: FrameSource, pace: PacingClock, *, skippable: bool = False) -> None:
        """Wrap a recording; stopping the clock ends the playback, also in the middle of a wait."""
        super().__init__(source)
        self._pace, self.paced, self.catch_up = pace, True, False
        self.skippable = skippable

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

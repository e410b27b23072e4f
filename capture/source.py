"""What every source of frames is, recorded or live."""

from collections.abc import Iterator
from pathlib import Path
from typing import Protocol, runtime_checkable

from capture.frame import Frame
from capture.selection import FrameSelection


@runtime_checkable
class FrameSource(Protocol):
    """A recorded or live stream of upright RGB frames of one size.

    Attributes:
        path: The video file or the folder of pictures itself.
        size_px: Width and height of every frame.
        selection: The frames that are wanted.
        frames_in_file: How many frames there are in all, wanted or not, as the container claims;
            of a live source 0.
        frame_count: How many of them are wanted; fewer may come, see `warnings`. None if nobody
            knows, of a live source.
        duration_s: How long the wanted frames last, as the container claims; None if nobody knows.
        has_alpha: Whether the frames' own alpha channel is their mask: it cuts the person out of
            one of the pictures that were looked at, and no segmenter was asked for instead.
        quarter_turns: How often stored pictures are turned by 90° against the clock to be upright.
        live: Whether frames that are not taken in time are lost.
        paced: Whether frames come at times of their own, however fast they are taken.
        waited_s: How long `frames()` has waited for frames, in all.
        dropped: How many frames were lost because nobody took them in time.
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
        """How many frames were lost because nobody took them in time."""
        ...

    def frames(self) -> Iterator[Frame]:
        """The frames, lazily and in order; every call starts anew."""
        ...

    def count_frames(self) -> int:
        """How many frames there really are in all, found by decoding; slow."""
        ...

    def close(self) -> None:
        """Ends `frames()`, also one that waits on another thread, and lets a device go."""
        ...

"""Where frames come from: a video file, a folder of pictures, or a capture folder with either."""

from collections.abc import Iterator
from pathlib import Path
from typing import Protocol, runtime_checkable

from capture.errors import BadInput
from capture.frame import Frame
from capture.pace import Pace
from capture.selection import Selection

VIDEO_SUFFIXES = frozenset(
    {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".3gp", ".ts", ".wmv"}
)


@runtime_checkable
class Source(Protocol):
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
        has_alpha: Whether the frames have an alpha channel of their own.
        live: Whether frames that are not taken in time are lost.
        paced: Whether frames come at times of their own, however fast they are taken.
        waited_s: How long `frames()` has waited for frames, in all.
        dropped: How many frames were lost because nobody took them in time.
        started_at: When the first frame of a live source was filmed, in seconds since 1970.
        warnings: What was wrong so far; grows while `frames()` is read.
    """

    path: Path
    size_px: tuple[int, int]
    selection: Selection
    frames_in_file: int
    frame_count: int | None
    duration_s: float | None
    has_alpha: bool
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


def open_source(path: Path, *, frames: slice | None = None) -> Source:
    """Opens a video file, a folder of pictures or a native capture folder.

    Args:
        path: A video, a folder of pictures, or a folder with `images/` or a single video in it.
        frames: Which frames are wanted; they keep their numbers. All if None.

    Raises:
        BadInput: If there is nothing there that can be read.
    """
    from capture.images import ImageFolder, list_images
    from capture.video import VideoFile

    selection = Selection.of(frames)
    if not path.exists():
        raise BadInput(f"{path} does not exist; a video or a folder of pictures was expected.")
    if not path.is_dir():
        return VideoFile(path, selection)
    if (path / "images").is_dir():
        return ImageFolder(path / "images", selection)
    videos = sorted(file for file in path.iterdir() if file.suffix.lower() in VIDEO_SUFFIXES)
    if list_images(path) and not videos:
        return ImageFolder(path, selection)
    if len(videos) != 1:
        found = ", ".join(file.name for file in videos) or "neither"
        raise BadInput(
            f"{path} is a folder; expected pictures, `images/` or a single video in it, found "
            f"{found}. Name the video itself."
        )
    return VideoFile(videos[0], selection)


def open_live(
    path: Path, camera: str | None, frames: slice | None, pace: Pace, *, idle_s: float
) -> Source:
    """Opens a camera, or a folder that another program writes pictures to.

    Args:
        path: The folder; a capture folder's pictures lie in its `images/`.
        camera: Number or address of a camera instead.
        frames: Which frames are wanted. All if None.
        pace: The clock of a folder.
        idle_s: No new picture for so long is a folder's end.

    Raises:
        BadInput: If there is no such camera, or no picture comes into the folder.
        OSError: If the camera cannot be used now.
    """
    from capture.camera_device import CameraDevice
    from capture.growing import GrowingFolder

    selection = Selection.of(frames)
    if camera is not None:
        return CameraDevice(camera, selection, pace)
    inside = path / "images"
    return GrowingFolder(inside if inside.is_dir() else path, selection, pace, idle_s=idle_s)

"""The inputs of a capture, as the user named them; quick to import, for the first line of a run."""

from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from pathlib import Path

from capture.live_sources import IDLE_TIMEOUT_S, camera_address
from preprocess.capture_paths import (
    CapturePaths,
    find_capture_paths,
    find_own_poses,
    find_parts,
)
from preprocess.plugins import segmenter_name

MIN_HEIGHT_CM, MAX_HEIGHT_CM = 40.0, 260.0
"""Range of heights of a person."""


class InputKind(Enum):
    """What the input of a command is: a recording with poses or without, or a stream.

    A stream without poses is tracked while it comes: a live source, or a recording that is played
    at its own speed.
    """

    POSED = "recorded, with poses"
    UNTRACKED = "recorded, to be tracked first"
    STREAMED = "tracked while it comes"


@dataclass(frozen=True, kw_only=True)
class CaptureInputs:
    """The inputs that the user named; the rest is looked for (see `find_capture_paths`).

    Attributes:
        video: Video file, folder of images, or capture folder.
        cameras: A file, "static", "solve" (poses are then in the camera of each frame, and so is
            all the rest until cameras were solved), or None.
        body: A body file; None for the embedded body.
        invert_masks: Whether the person is dark in the masks; None finds out.
        live: Whether `video` is a folder that grows; a camera is live without it.
        person: Whose poses, where the file holds several people's; None for the longest track.
        idle_s: Longest time without a new image from a live source, seconds.
        watch_s: Time after which new images in a live folder are not waited for; None: no limit.
        height_m: Height of the person; None if only the poses tell.
        tracker: Name of the tracker that finds poses where none are given; None: the built-in one.
        refine_masks: Whether given masks are refined where their borders miss the images' edges.
        rotate: Degrees by which frames are turned clockwise; masks, poses and cameras are those of
            turned frames.
        realtime: Whether a recording is played at its own speed, as a camera would.
    """

    video: Path
    poses: Path | None = None
    masks: Path | None = None
    cameras: str | None = None
    body: Path | None = None
    frames: slice | None = None
    invert_masks: bool | None = None
    live: bool = False
    person: str | None = None
    idle_s: float = IDLE_TIMEOUT_S
    watch_s: float | None = None
    height_m: float | None = None
    tracker: str | None = None
    refine_masks: bool = True
    rotate: int = 0
    realtime: bool = False

    @property
    def camera(self) -> str | None:
        """Number or address of the camera, if the video is one."""
        return camera_address(self.video)

    @property
    def is_live(self) -> bool:
        """Return whether frames come from a camera, or from a folder that still grows."""
        return self.live or self.camera is not None

    @cached_property
    def kind(self) -> InputKind:
        """What the input is; a video that does not exist counts as posed."""
        if self.is_live:
            return InputKind.STREAMED
        if self.poses or find_own_poses(self.video) or not self.video.exists():
            return InputKind.POSED
        return InputKind.STREAMED if self.realtime else InputKind.UNTRACKED

    def find_paths(self) -> CapturePaths:
        """The parts of a recording with poses; an InputError if one is missing."""
        named = self.masks if segmenter_name(self.masks) is None else None
        return find_capture_paths(self.video, self.poses, named, self.cameras)

    def input_paths(self) -> list[Path]:
        """Paths that no output may touch: those that were named, and those that may be found."""
        named = [self.poses, self.body]
        if self.camera is None:
            named.append(self.video)
        if segmenter_name(self.masks) is None:
            named.append(self.masks)
        if self.cameras not in (None, "static", "solve"):
            named.append(Path(self.cameras))
        given = [path for path in named if path is not None]
        near = {path if path.is_dir() else path.parent for path in (self.video, self.poses) if path}
        return [*given, *find_parts(sorted(near))]

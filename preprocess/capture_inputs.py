"""The inputs of a capture, as the user named them; quick to import, for the first line of a run."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from pathlib import Path

from capture.input_error import InputError
from capture.live_sources import IDLE_TIMEOUT_S, camera_address
from preprocess.plugins import check_installed, segmenter_name

POSE_FILE_NAMES = [
    "poses.npz",
    "poses.pkl",
    "hmr4d_results.pt",
    "wham_output.pkl",
    "vibe_output.pkl",
]
"""Names under which poses lie in a capture folder."""
MASK_NAMES = ["masks", "masks.npz", "masks.npy", "masks.mp4", "masks.json"]
"""Names under which masks lie in a capture folder."""


CAMERA_NAMES = ["cameras.npz", "transforms.json", "sparse"]
"""Names under which cameras lie in a capture folder, in the order of preference."""


@dataclass(frozen=True, kw_only=True)
class CapturePaths:
    """The paths of the parts of a capture; `cameras` is None for a static camera without a file."""

    video: Path
    poses: Path
    masks: Path | None
    cameras: Path | None


def find_parts(folders: Iterable[Path]) -> list[Path]:
    """List the files in some folders that have the names of a capture's parts."""
    names = [*POSE_FILE_NAMES, *MASK_NAMES, *CAMERA_NAMES, "images"]
    return [path for folder in folders for name in names if (path := folder / name).exists()]


def find_own_poses(video: Path) -> Path | None:
    """The poses in a capture folder; None if there are none, or `video` is no folder."""
    return _first_existing([video], POSE_FILE_NAMES)


def find_own_masks(video: Path, poses: Path | None = None) -> Path | None:
    """The masks in a capture folder, beside a video, or beside its poses; None without any."""
    return _first_existing(_search_folders(video, poses), MASK_NAMES)


def find_cameras(video: Path, named: str | None, poses: Path | None = None) -> Path | None:
    """The cameras that are named, or those in a capture folder, beside a video or its poses.

    `named` is the value of --cameras: a file, "static" or "solve" (nothing is known yet), or None.
    """
    if named in ("static", "solve"):
        return None
    folders = _search_folders(video, poses)
    return _first_existing(folders, CAMERA_NAMES) if named is None else Path(named)


def _search_folders(video: Path, poses: Path | None) -> list[Path]:
    inside = video.is_dir() and video.name != "images"
    folders = [] if camera_address(video) is not None else [video if inside else video.parent]
    return folders if poses is None else [*folders, poses.parent]


def _first_existing(folders: list[Path], names: list[str]) -> Path | None:
    candidates = (folder / name for folder in folders if folder.is_dir() for name in names)
    return next((path for path in candidates if path.exists()), None)


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
    """The inputs that the user named; the rest is looked for (see `find_paths`).

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
        """The parts of a recording with poses; an InputError if one is missing.

        For a folder, everything defaults to the files in it. For a file (and a folder that is named
        `images`), masks and cameras are looked for beside it, then beside the poses.
        """
        self.check_named()
        video, poses = self.video, self.poses or find_own_poses(self.video)
        if poses is None:
            other = find_own_poses(video.parent)
            hint = "" if other is None else f" {other} lies beside it: is it meant?"
            raise InputError(
                f"No poses for {video}: give --poses FILE (an .npz in InstantAvatar's keys, or "
                f"what a tracker wrote: docs/formats.md).{hint} ia-track finds poses in a video."
            )
        named = self.masks if segmenter_name(self.masks) is None else None
        return CapturePaths(
            video=video, poses=poses, masks=named or find_own_masks(video, poses),
            cameras=find_cameras(video, self.cameras, poses),
        )  # fmt: skip

    def input_paths(self) -> list[Path]:
        """Paths that no output may touch: those that were named, and those that may be found."""
        video = [] if self.camera is not None else [self.video]
        near = {path if path.is_dir() else path.parent for path in (self.video, self.poses) if path}
        return [*self._named_parts(), *video, *find_parts(sorted(near))]

    def check_named(self) -> None:
        """Raise an InputError for a part of a recording that is named, but not there.

        It reads and loads nothing, so that a slip in a name is found at once.
        """
        for path in [] if self.is_live else [self.video, *self._named_parts()]:
            if not path.exists():
                raise InputError(f"{path} does not exist; check the path.")
        check_installed(self.tracker, segmenter_name(self.masks))

    def _named_parts(self) -> list[Path]:
        """The files and folders that were named, but for the video."""
        named = [self.poses, self.body]
        if segmenter_name(self.masks) is None:
            named.append(self.masks)
        if self.cameras not in (None, "static", "solve"):
            named.append(Path(self.cameras))
        return [path for path in named if path is not None]

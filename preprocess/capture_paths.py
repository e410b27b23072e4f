"""Find the parts of a capture: as named, in its folder, or beside it."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from capture.input_error import InputError
from capture.live_sources import camera_address

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


def resolve_pose_path(path: Path) -> Path:
    """The pose file of a capture folder, if `path` is one; else `path` itself."""
    return _first_existing([path], POSE_FILE_NAMES) or path


def find_capture_paths(
    video: Path,
    poses: Path | None = None,
    masks: Path | None = None,
    cameras: Path | str | None = None,
) -> CapturePaths:
    """Find the parts that the user did not name.

    For a folder, everything defaults to the files in it. For a file (and a folder that is named
    `images`), masks and cameras are looked for beside it, then beside the poses.

    Args:
        video: Video file, folder of images, or native capture folder.
        poses: Pose file; needed unless `video` is a folder that holds one of `POSE_FILE_NAMES`.
        cameras: Camera file; "static" for a static camera without a description; "solve" for a
            moving one, for which no file is looked for either.
    """
    if str(cameras) == "solve":  # nothing lies anywhere: until then each frame has its own camera
        cameras = "static"
    named = [Path(p) for p in (video, poses, masks) if p is not None]
    if cameras is not None and str(cameras) != "static":
        named.append(Path(cameras))
    for path in named:
        if not path.exists():
            raise InputError(f"{path} does not exist; check the path.")
    if poses is None:
        poses = find_own_poses(video)
    if poses is None:
        other = _first_existing([video.parent], POSE_FILE_NAMES)
        hint = "" if other is None else f" {other} lies beside it: is it meant?"
        raise InputError(
            f"No poses for {video}: give --poses FILE (an .npz in InstantAvatar's keys, or what a "
            f"tracker wrote: docs/formats.md).{hint} ia-track finds poses in a video."
        )
    if cameras is None:
        cameras = find_own_cameras(video, poses)
    return CapturePaths(
        video=video,
        poses=poses,
        masks=masks or find_own_masks(video, poses),
        cameras=None if cameras is None or str(cameras) == "static" else Path(cameras),
    )


def find_own_poses(video: Path) -> Path | None:
    """The poses in a capture folder; None if there are none, or `video` is no folder."""
    return _first_existing([video], POSE_FILE_NAMES)


def find_own_masks(video: Path, poses: Path | None = None) -> Path | None:
    """The masks in a capture folder, beside a video, or beside its poses; None without any."""
    return _first_existing(_search_folders(video, poses), MASK_NAMES)


def find_own_cameras(video: Path, poses: Path | None = None) -> Path | None:
    """The cameras in a capture folder, beside a video, or beside its poses; None without any."""
    return _first_existing(_search_folders(video, poses), CAMERA_NAMES)


def find_stream_cameras(video: Path, named: str | None) -> Path | None:
    """The cameras of a video or a live source without poses; None without any.

    `named` is the value of --cameras: a file, "static" or "solve" (nothing is known yet), or None.
    """
    if named in ("static", "solve"):
        return None
    return find_own_cameras(video) if named is None else Path(named)


def _search_folders(video: Path, poses: Path | None) -> list[Path]:
    inside = video.is_dir() and video.name != "images"
    folders = [] if camera_address(video) is not None else [video if inside else video.parent]
    return folders if poses is None else [*folders, poses.parent]


def _first_existing(folders: list[Path], names: list[str]) -> Path | None:
    candidates = (folder / name for folder in folders if folder.is_dir() for name in names)
    return next((path for path in candidates if path.exists()), None)

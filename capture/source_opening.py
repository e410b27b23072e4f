"""Opens a source of frames: a video file, a folder of images, a capture folder, a camera."""

from pathlib import Path

import numpy as np

from capture.image_folder import IMAGE_SUFFIXES, ImageFolder, list_images
from capture.input_error import InputError, counted
from capture.live_sources import CameraDevice, WatchedImageFolder
from capture.received_video import ReceivedVideo, note_of
from capture.source import Frame, FrameSelection, FrameSource, PacingClock, RotatedSource
from capture.video import VIDEO_SUFFIXES, VideoFile

HEIC_SUFFIXES = frozenset({".heic", ".heif"})
"""File endings of phone images that OpenCV does not read."""
NON_VIDEO_SUFFIXES = HEIC_SUFFIXES | {".txt", ".npz", ".npy", ".pkl", ".json", ".zip", ".pt"}
"""Endings of files that are named as a video by mistake."""
SIDE_VIDEO_PREFIXES = ("mask", "preview", "skeleton")
"""Starts of the names of videos that lie beside the one that is meant."""


def open_source(path: Path, *, frames: slice | None = None, rotate: int = 0) -> FrameSource:
    """Open a video file, a folder of images, or a folder with `images/` or a single video in it.

    Selected `frames` keep their numbers; all if None. They are turned clockwise by `rotate`
    degrees.
    """
    source = _open_recording(path, FrameSelection.of(frames))
    return RotatedSource(source, rotate) if rotate else source


def reopen(source: FrameSource, frames: slice | None) -> FrameSource:
    """Open other frames of a recording, turned as it is."""
    return open_source(source.path, frames=frames, rotate=source.rotate)


GLANCES = 6
"""Places of a recording, evenly spread, that are looked at before it is read."""
GLANCE_APART_S = 0.2
"""Time between the two frames of a place, which show how the camera moves, seconds."""


def glance(source: FrameSource) -> list[tuple[Frame, Frame]]:
    """Reduced frames at a few places of a recording, and for each one soon after it."""
    recording = _open_recording(source.path, source.selection)
    span = source.selection.span(source.frames_in_file)
    rate = span / (source.duration_s or 1.0)
    apart = 1.0 if source.path.is_dir() else GLANCE_APART_S * rate
    last = max(0.0, span - 1.0 - apart)
    places = np.unique(np.round((np.arange(GLANCES) + 0.5) * last / GLANCES))
    places += source.selection.start
    pairs = recording.glance((places / rate).tolist(), GLANCE_APART_S, 960)
    return [(one.turn(source.rotate), other.turn(source.rotate)) for one, other in pairs]


def describe_recording(source: FrameSource) -> str:
    """Name, number, size and rate of a recording's frames, as its container states them."""
    size = f"{source.size_px[0]}x{source.size_px[1]} px"
    chosen = "" if source.frame_count == source.frames_in_file else f"{source.frame_count} of "
    name, in_file = f"{source.path.name}: {chosen}", source.frames_in_file
    if not source.duration_s or source.path.is_dir():
        return f"{name}{counted(in_file, 'image')} of {size}"
    rate = source.selection.span(in_file) / source.duration_s
    hdr = ", HDR (tone mapped)" if source.is_hdr else ""
    return f"{name}{counted(in_file, 'frame')} of {size}, {rate:.3g} a second{hdr}"


def _open_recording(path: Path, selection: FrameSelection) -> VideoFile | ImageFolder:
    if not path.exists():
        raise InputError(f"{path} does not exist; a video or a folder of pictures was expected.")
    if not path.is_dir():
        if path.suffix.lower() in IMAGE_SUFFIXES | NON_VIDEO_SUFFIXES:
            raise InputError(
                f"{path} is no video; expected one ({', '.join(sorted(VIDEO_SUFFIXES))}), or a "
                "folder of pictures."
            )
        return VideoFile(path, selection)
    if (path / "images").is_dir():
        return ImageFolder(path / "images", selection)
    videos = _list_videos(path)
    if list_images(path) and not videos:
        return ImageFolder(path, selection)
    if len(videos) != 1:
        raise _ambiguous_folder_error(path, videos)
    return VideoFile(videos[0], selection)


def _list_videos(folder: Path) -> list[Path]:
    """List the videos in a folder; masks and previews do not count where there is another."""
    files = (file for file in folder.iterdir() if file.suffix.lower() in VIDEO_SUFFIXES)
    seen = sorted(file for file in files if not file.name.startswith("."))
    return [file for file in seen if not file.stem.lower().startswith(SIDE_VIDEO_PREFIXES)] or seen


def _ambiguous_folder_error(path: Path, videos: list[Path]) -> InputError:
    if videos:
        found, advice = ", ".join(file.name for file in videos), "Name the video itself."
    else:
        endings = {file.suffix.lower() for file in path.iterdir() if file.suffix}
        found = f"files ending in {', '.join(sorted(endings))}" if endings else "neither"
        heic = "HEIC pictures must be converted, to JPEG or PNG."
        advice = heic if endings & HEIC_SUFFIXES else "Name the folder that holds them."
    return InputError(
        f"{path} is a folder; expected pictures, `images/` or a single video in it, found "
        f"{found}. {advice}"
    )


def open_live_source(
    path: Path,
    camera: str | None,
    frames: slice | None,
    pace: PacingClock,
    *,
    idle_s: float,
    watch_s: float | None = None,
    rotate: int = 0,
) -> FrameSource:
    """Open a camera, a folder that another program writes images to, or a video that is received.

    A capture folder's images lie in its `images/`; `camera` is the number or address of a camera
    instead. Waiting times are as in `WatchedImageFolder`; images are turned clockwise by `rotate`
    degrees.
    """
    selection = FrameSelection.of(frames)
    source: FrameSource
    if camera is not None:
        source = CameraDevice(camera, selection, pace)
    elif note_of(path).is_file():
        source = ReceivedVideo(path, selection, pace, idle_s=idle_s)
    else:
        folder = path / "images" if (path / "images").is_dir() else path
        source = WatchedImageFolder(folder, selection, pace, idle_s=idle_s, watch_s=watch_s)
    return RotatedSource(source, rotate) if rotate else source

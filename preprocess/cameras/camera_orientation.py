"""Cameras of upright images: of images that a rotation flag turns, and before poses are known."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from capture.camera import Camera
from capture.input_error import InputError
from capture.source import FrameSource
from preprocess.body.body_pose import RelativeFocalLength
from preprocess.cameras.camera_file import DEFAULT_FOCAL_RATIO, CameraTrack, read_cameras
from preprocess.cameras.camera_registry import is_colmap_model
from preprocess.capture_paths import find_stream_cameras


def read_upright_cameras(path: Path, source: FrameSource) -> CameraTrack:
    """Read the cameras of frames that a video's or an image's flag turned upright.

    Cameras that were made for the images as they are stored are turned with them. Their width and
    height tell which they were made for; where an .npz states none, their principal point does.
    Photographs that hang upside down have one size either way: there COLMAP's cameras are known to
    be those of the stored ones, as COLMAP leaves tags alone, and others are left as they are (so
    are those of videos, as programs that extract images from videos turn them).
    """
    if source.quarter_turns % 2 == 0:
        track = _read(path, source, source.size_px)
        upside_down = source.quarter_turns == 2 and source.path.is_dir()
        return _rotate(track, path, source) if upside_down and is_colmap_model(path) else track
    width, height = source.size_px
    try:
        stored = _read(path, source, (height, width))
    except InputError:
        return _read(path, source, source.size_px)
    try:
        shown = _read(path, source, source.size_px)
    except InputError:
        return _rotate(stored, path, source)
    is_shown = _principal_point_offset_px(shown) <= _principal_point_offset_px(stored)
    return shown if is_shown else _rotate(stored, path, source)


def _read(path: Path, source: FrameSource, size_px: tuple[int, int]) -> CameraTrack:
    """Cameras for images of a size; those of a live source are not known by name or number."""
    return read_cameras(path, size_px, None if source.live else source)


def _rotate(stored: CameraTrack, path: Path, source: FrameSource) -> CameraTrack:
    """Turn the cameras of stored images with them."""
    note = f"The cameras in {path.name} were turned with the images, by their rotation flag."
    return replace(
        stored,
        cameras=tuple(each.rotate_quarter_turns(source.quarter_turns) for each in stored.cameras),
        note=note if stored.note is None else f"{stored.note} {note}",
    )


def _principal_point_offset_px(track: CameraTrack) -> float:
    camera = track.cameras[0]
    return float(np.abs(np.array(camera.center_px) - np.array(camera.size_px) / 2.0).sum())


def assume_camera(video: Path, named: str | None, source: FrameSource) -> Camera:
    """A camera at the origin: the first one of a file, or a phone's where there is none.

    `named` is the value of --cameras; without it cameras are looked for beside the video (see
    `find_stream_cameras`).
    """
    path = find_stream_cameras(video, named)
    if path is None:
        phone = RelativeFocalLength(ratio=DEFAULT_FOCAL_RATIO).intrinsic_matrix(source.size_px)
        return Camera.from_intrinsic(phone, source.size_px)
    return replace(read_upright_cameras(path, source)[0], camera_from_world=np.eye(4))

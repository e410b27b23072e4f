"""Cameras of upright pictures: of those that a rotation flag turns, and before poses are known."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from capture.camera import Camera
from capture.image_folder import exif_orientation, list_images
from capture.input_error import InputError
from capture.source import FrameSource
from preprocess.body.body_pose import RelativeFocalLength
from preprocess.cameras.camera_file import DEFAULT_FOCAL_RATIO, CameraTrack, read_cameras
from preprocess.cameras.camera_registry import find_colmap_model
from preprocess.capture_paths import find_stream_cameras

MIRRORED_EXIF_QUARTER_TURNS = {2: 0, 4: 2, 5: 1, 7: 3}
"""Counter-clockwise quarter turns that make a mirrored photograph upright after left and right were
exchanged, by EXIF's orientation."""


def read_upright_cameras(path: Path, source: FrameSource) -> CameraTrack:
    """The cameras of frames that were turned to stand upright, by a video's or a picture's flag.

    Cameras that were made for the pictures as they are stored are turned with them. Which they were
    made for, their width and height tell; where an .npz states none, their principal point does.
    Photographs that hang upside down have one size either way: there COLMAP's cameras are known to
    be those of the stored ones, as COLMAP leaves tags alone, and others are left as they are (so
    are those of videos, as what takes videos apart turns their pictures).

    Photographs that a tag mirrors are shown as the eye saw them. Cameras that were made for them as
    stored stand in a mirror's world, and are mirrored back with it.

    Args:
        path: See `read_cameras`.
        source: The frames; see `read_cameras`.

    Raises:
        InputError: As `read_cameras`.
    """
    of_colmap = (
        find_colmap_model(path) if path.is_dir() else path.suffix.lower() in (".bin", ".txt")
    )
    if (tag := _mirrored_exif_orientation(source)) is not None:
        return _read_mirrored(path, source, tag, of_colmap=bool(of_colmap))
    if source.quarter_turns % 2 == 0:
        track = read_cameras(path, source.size_px, None if source.live else source)
        hang = source.quarter_turns == 2 and source.path.is_dir()
        return _rotate_track(track, path, source) if hang and of_colmap else track
    width, height = source.size_px
    shown = _try_read(path, (width, height), source)
    stored = _try_read(path, (height, width), source)
    if isinstance(stored, InputError) or (
        isinstance(shown, CameraTrack)
        and _principal_point_offset_px(shown) <= _principal_point_offset_px(stored)
    ):
        if isinstance(shown, InputError):
            raise shown
        return shown
    return _rotate_track(stored, path, source)


def _mirrored_exif_orientation(source: FrameSource) -> int | None:
    """EXIF's orientation of photographs that it mirrors; None of all others."""
    if source.live or not source.path.is_dir():
        return None
    for path in list_images(source.path):
        data = path.read_bytes()
        if data:
            tag = exif_orientation(data)
            return tag if tag in MIRRORED_EXIF_QUARTER_TURNS else None
    return None


def _read_mirrored(path: Path, source: FrameSource, tag: int, *, of_colmap: bool) -> CameraTrack:
    """Cameras of photographs that a tag mirrors, of them as shown or as stored."""
    width, height = source.size_px
    stored_px = (height, width) if MIRRORED_EXIF_QUARTER_TURNS[tag] % 2 else (width, height)
    shown, stored = _try_read(path, (width, height), source), _try_read(path, stored_px, source)
    if isinstance(stored, CameraTrack) and (of_colmap or isinstance(shown, InputError)):
        said = f"The cameras in {path.name} were mirrored with the pictures, by their EXIF tag."
        return _map_cameras(
            stored,
            said,
            lambda camera: camera.mirror().rotate_quarter_turns(MIRRORED_EXIF_QUARTER_TURNS[tag]),
        )
    if isinstance(shown, InputError):
        raise shown
    said = (
        f"The photographs are mirrored by their EXIF tag (orientation {tag}); the cameras in "
        f"{path.name} are taken for those of the pictures as shown."
    )
    return _map_cameras(shown, said, lambda camera: camera)


def _rotate_track(stored: CameraTrack, path: Path, source: FrameSource) -> CameraTrack:
    """Cameras of stored pictures, turned with them."""
    said = f"The cameras in {path.name} were turned with the pictures, by their rotation flag."
    return _map_cameras(
        stored, said, lambda camera: camera.rotate_quarter_turns(source.quarter_turns)
    )


def _map_cameras(track: CameraTrack, said: str, change: Callable[[Camera], Camera]) -> CameraTrack:
    """Change all cameras, and add a sentence to the note."""
    return replace(
        track,
        cameras=tuple(change(camera) for camera in track.cameras),
        note=said if track.note is None else f"{track.note} {said}",
    )


def _try_read(
    path: Path, size_px: tuple[int, int], source: FrameSource
) -> CameraTrack | InputError:
    """The cameras for pictures of a size, or why they are none."""
    try:
        return read_cameras(path, size_px, None if source.live else source)
    except InputError as cause:
        return cause


def _principal_point_offset_px(track: CameraTrack) -> float:
    """How far the first camera's principal point is from the middle of its picture, in pixels."""
    camera = track.cameras[0]
    return float(np.abs(np.array(camera.center_px) - np.array(camera.size_px) / 2.0).sum())


def assume_camera(video: Path, named: str | None, source: FrameSource) -> Camera:
    """A camera at the origin: the first one of a file, or a phone's where there is none.

    Args:
        video: The video, beside which cameras may lie.
        named: Value of --cameras; see `find_stream_cameras`.
        source: The video's frames.

    Raises:
        InputError: If a file of cameras cannot be read.
    """
    path = find_stream_cameras(video, named)
    if path is None:
        phone = RelativeFocalLength(ratio=DEFAULT_FOCAL_RATIO).intrinsic_matrix(source.size_px)
        return Camera.from_intrinsic(phone, source.size_px)
    return replace(read_upright_cameras(path, source)[0], camera_from_world=np.eye(4))

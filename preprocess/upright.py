"""Cameras of pictures that a rotation flag turns: made for them as stored, or as shown?"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from capture.errors import BadInput
from capture.source import Source
from preprocess.camera_file import CameraTrack, read_cameras
from preprocess.cameras.colmap import find_model


def upright_cameras(path: Path, source: Source) -> CameraTrack:
    """The cameras of frames that were turned to stand upright, by a video's or a picture's flag.

    Cameras that were made for the pictures as they are stored are turned with them. Which they were
    made for, their width and height tell; where an .npz states none, their principal point does.
    Photographs that hang upside down have one size either way: there COLMAP's cameras are known to
    be those of the stored ones, as COLMAP leaves tags alone, and others are left as they are (so
    are those of videos, as what takes videos apart turns their pictures).

    Args:
        path: See `read_cameras`.
        source: The frames; see `read_cameras`.

    Raises:
        BadInput: As `read_cameras`.
    """
    if source.quarter_turns % 2 == 0:
        track = read_cameras(path, source.size_px, None if source.live else source)
        of_colmap = find_model(path) if path.is_dir() else path.suffix in (".bin", ".txt")
        hang = source.quarter_turns == 2 and source.path.is_dir()
        return _turned(track, path, source) if hang and of_colmap else track
    width, height = source.size_px
    shown = _tried(path, (width, height), source)
    stored = _tried(path, (height, width), source)
    if isinstance(stored, BadInput) or (
        isinstance(shown, CameraTrack) and _off(shown) <= _off(stored)
    ):
        if isinstance(shown, BadInput):
            raise shown
        return shown
    return _turned(stored, path, source)


def _turned(stored: CameraTrack, path: Path, source: Source) -> CameraTrack:
    """Cameras of stored pictures, turned with them."""
    said = f"The cameras in {path.name} were turned with the pictures, by their rotation flag."
    return replace(
        stored,
        cameras=tuple(camera.turned(source.quarter_turns) for camera in stored.cameras),
        note=said if stored.note is None else f"{stored.note} {said}",
    )


def _tried(path: Path, size_px: tuple[int, int], source: Source) -> CameraTrack | BadInput:
    """The cameras for pictures of a size, or why they are none."""
    try:
        return read_cameras(path, size_px, None if source.live else source)
    except BadInput as cause:
        return cause


def _off(track: CameraTrack) -> float:
    """How far the first camera's principal point is from the middle of its picture, in pixels."""
    camera = track.cameras[0]
    return float(np.abs(np.array(camera.center_px) - np.array(camera.size_px) / 2.0).sum())

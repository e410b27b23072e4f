"""The camera that a video's key points are lifted with, before any pose is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from capture.camera import Camera
from capture.source import FrameSource
from preprocess.body.body_pose import RelativeFocalLength
from preprocess.cameras.camera_file import DEFAULT_FOCAL_RATIO
from preprocess.cameras.camera_orientation import read_upright_cameras
from preprocess.capture_paths import find_own_cameras


def assume_camera(video: Path, named: str | None, source: FrameSource) -> Camera:
    """A camera at the origin: the first one of a file, or a phone's where there is none.

    Args:
        video: The video, beside which cameras may lie.
        named: Value of --cameras: a file, "static" or "solve", of which nothing is known yet, or
            None.
        source: The video's frames.

    Raises:
        InputError: If a file of cameras cannot be read.
    """
    unknown = named in ("static", "solve") or source.live
    path = None if unknown else named or find_own_cameras(video)
    if path is None:
        phone = RelativeFocalLength(ratio=DEFAULT_FOCAL_RATIO).intrinsic_matrix(source.size_px)
        return Camera.from_intrinsic(phone, source.size_px)
    return replace(read_upright_cameras(Path(path), source)[0], camera_from_world=np.eye(4))

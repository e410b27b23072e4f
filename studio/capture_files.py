"""Files of a capture folder as the studio writes them: lossless video, cameras, PNG pictures."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from capture.camera import Camera
from capture.image_folder import silence_opencv
from capture.input_error import InputError


def write_cameras(path: Path, cameras: tuple[Camera, ...]) -> None:
    """One camera, or one a frame, with their common K."""
    extrinsics = np.stack([camera.camera_from_world for camera in cameras])
    width, height = cameras[0].size_px
    np.savez(
        path,
        intrinsic=cameras[0].intrinsic,
        extrinsic=extrinsics[0] if len(cameras) == 1 else extrinsics,
        height=height,
        width=width,
    )


@contextmanager
def lossless_video(
    path: Path, size_px: tuple[int, int], fps: float, frames: int
) -> Iterator[cv2.VideoWriter]:
    """A writer of BGR pictures into an .mp4 of FFV1; the file is checked in the end.

    Raises:
        InputError: If this OpenCV cannot write it.
        OSError: If the disk is full.
    """
    # The default mp4v costs 30 dB on stripes; FFV1 is exact, fast, and OpenCV reads it.
    silence_opencv()
    code = cv2.VideoWriter.fourcc(*"FFV1")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, fps, size_px)
    if not writer.isOpened():
        path.write_bytes(bytes(1 << 16))  # says so if there is no room
        raise InputError(
            f"OpenCV {cv2.__version__} cannot write a lossless video (FFV1 in .mp4); 4.13 or newer "
            "can: pip install --upgrade opencv-contrib-python-headless."
        )
    try:
        yield writer
    finally:
        writer.release()
    _check_video(path, frames)


def _check_video(path: Path, frames: int) -> None:
    """Count the frames of the file: OpenCV does not report write errors."""
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    written = int(video.get(cv2.CAP_PROP_FRAME_COUNT)) if video.isOpened() else 0
    video.release()
    if written != frames:
        raise OSError(errno.ENOSPC, f"only {written} of {frames} video frames could be written")


def to_uint8(alpha: Float32[np.ndarray, "height width"]) -> UInt8[np.ndarray, "height width"]:
    """Alpha in [0, 1] as 8 bits."""
    return (alpha * 255.0 + 0.5).astype(np.uint8)


def write_png(path: Path, image: UInt8[np.ndarray, "..."]) -> None:
    """A PNG in OpenCV's channel order; unlike OpenCV's own writer it says when the disk is full."""
    _, code = cv2.imencode(".png", image)
    path.write_bytes(code.tobytes())

"""Pictures to a video file: H.264 and VP9 by PyAV where it is installed, else what OpenCV can.

Lossless video (FFV1) is OpenCV's.
"""

import errno
import importlib
import importlib.util
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from capture.image_folder import silence_opencv
from capture.input_error import InputError

Pixels = UInt8[np.ndarray, "height width channels"]
VIDEO_EXTRA_INSTALL = "pip install 'instant-avatar-stream[video]'"
"""Command that installs PyAV, for messages."""

H264 = ("libx264", {"crf": "17", "preset": "medium"})
"""FFmpeg's encoder of MP4, and its options."""
VP9 = ("libvpx-vp9", {"crf": "22", "b:v": "0", "deadline": "good", "cpu-used": "4", "row-mt": "1"})
"""FFmpeg's encoder of WebM with an alpha channel, and its options."""
BT709_LIMITED = {"colorspace": 1, "color_primaries": 1, "color_trc": 1, "color_range": 1}
"""Color tags (codes of ITU-T H.273), so that every player shows the same colors."""
YUV_ROUNDING = np.array([1, 0, 2], dtype=np.uint8)
"""Added to RGB before OpenCV converts to YUV and rounds down: gray came back darker by (4, 2, 5).
White cannot be raised, and comes back as (251, 253, 250)."""


@dataclass(frozen=True, kw_only=True)
class ClipEncoder:
    """One way to write a clip.

    Attributes:
        description: What is written, and where it plays, for the user.
        write: Takes the path, pictures of one size (RGB, or RGBA with straight alpha) and the
            pictures a second; returns how many there were.
    """

    description: str
    write: Callable[[Path, Iterator[Pixels], float], int]


def video_encoder(suffix: str, *, transparent: bool) -> ClipEncoder:
    """The best there is here for a video.

    Args:
        suffix: ".webm" or ".mp4".
        transparent: Whether alpha shall be kept.

    Raises:
        InputError: If alpha cannot be kept.
    """
    if transparent and suffix == ".mp4":
        raise InputError(
            "--background transparent: an .mp4 has no transparency; .webp, .webm, .gif and a "
            "folder of frames have."
        )
    codec, options = H264 if suffix == ".mp4" else VP9
    if _pyav_has(codec):
        name = "H.264, which plays everywhere" if suffix == ".mp4" else "VP9, which browsers play"
        if transparent:
            name = "VP9 with alpha, which Chrome and Firefox show"
        layout = "yuva420p" if transparent else "yuv420p"
        return ClipEncoder(
            description=name,
            write=partial(_write_av, codec=codec, options=options, layout=layout),
        )
    if transparent:
        raise InputError(
            "--background transparent: .webm with alpha needs PyAV. Install it "
            f"({VIDEO_EXTRA_INSTALL}), or write .webp, .gif or a folder of frames."
        )
    code, description = "VP80", "VP8, which browsers play"
    if suffix == ".mp4" and _opencv_has("avc1"):
        code, description = "avc1", "H.264, which plays everywhere"
    elif suffix == ".mp4":
        code = "mp4v"
        description = (
            "MPEG-4 part 2, for there is no H.264 encoder here: browsers do not play it; .webm "
            f"they do, and {VIDEO_EXTRA_INSTALL} brings H.264"
        )
    return ClipEncoder(description=description, write=partial(_write_opencv, code=code))


def _pyav_has(codec: str) -> bool:
    if importlib.util.find_spec("av") is None:
        return False
    av: Any = importlib.import_module("av")  # an extra: type checkers may not know it
    return codec in av.codecs_available


def _write_av(
    path: Path,
    pictures: Iterator[Pixels],
    fps: float,
    *,
    codec: str,
    options: dict[str, str],
    layout: str,
) -> int:
    """By PyAV. VP9's alpha needs frames that hide no others, which `auto-alt-ref` would make."""
    av: Any = importlib.import_module("av")
    reformatter: Any = importlib.import_module("av.video.reformatter")
    options = {**options, "auto-alt-ref": "0"} if layout == "yuva420p" else options
    whole = {"movflags": "+faststart"} if path.suffix.lower() == ".mp4" else {}
    count = 0
    with av.open(str(path), "w", options=whole) as file:
        stream = file.add_stream(
            codec, rate=Fraction(fps).limit_denominator(10_000), options=options
        )
        stream.pix_fmt = layout
        for name, value in BT709_LIMITED.items():
            setattr(stream.codec_context, name, value)
        for picture in pictures:
            even = _pad_to_even(picture)
            if not count:
                stream.height, stream.width = even.shape[:2]
            frame = av.VideoFrame.from_ndarray(
                np.ascontiguousarray(even), format="rgb24" if even.shape[2] == 3 else "rgba"
            ).reformat(
                format=layout,
                src_color_range=reformatter.ColorRange.JPEG,
                dst_color_range=reformatter.ColorRange.MPEG,
                dst_colorspace=reformatter.Colorspace.ITU709,
            )
            frame.pts = count
            file.mux(stream.encode(frame))
            count += 1
        file.mux(stream.encode(None))
    return count


def _opencv_has(code: str) -> bool:
    """Whether OpenCV can open such a video; it opens one in memory's place, a passing file."""
    import tempfile

    silence_opencv()
    with tempfile.TemporaryDirectory() as folder:
        fourcc = cv2.VideoWriter.fourcc(*code)
        with _silence_stderr():
            writer = cv2.VideoWriter(
                str(Path(folder) / "probe.mp4"), cv2.CAP_FFMPEG, fourcc, 30.0, (64, 64)
            )
            able = writer.isOpened()
            writer.release()
    return able


def _write_opencv(path: Path, pictures: Iterator[Pixels], fps: float, code: str) -> int:
    silence_opencv()
    path.write_bytes(bytes(1 << 16))  # OpenCV does not say that there is no room; Python does
    writer, count = None, 0
    try:
        for picture in pictures:
            even = _pad_to_even(picture)
            if writer is None:
                size_px = (even.shape[1], even.shape[0])
                fourcc = cv2.VideoWriter.fourcc(*code)
                with _silence_stderr():
                    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, fps, size_px)
                if not writer.isOpened():
                    raise InputError(
                        f"This OpenCV cannot write {code} video. {VIDEO_EXTRA_INSTALL} can, or "
                        "choose .webp, .gif or a folder of frames."
                    )
            lifted = np.minimum(even, 255 - YUV_ROUNDING) + YUV_ROUNDING
            writer.write(np.ascontiguousarray(lifted[..., ::-1]))
            count += 1
    finally:
        if writer is not None:
            writer.release()
    _check_frame_count(path, count)
    return count


@contextmanager
def _silence_stderr() -> Iterator[None]:
    """Keeps FFmpeg from saying on stderr that WebM names its codecs in another way."""
    sys.stderr.flush()
    kept, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)


def _pad_to_even(picture: Pixels) -> UInt8[np.ndarray, "even_height even_width channels"]:
    """Video codecs want even sizes: the last row or column is doubled where needed."""
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _check_frame_count(path: Path, count: int) -> None:
    """OpenCV does not say when it could not write; so the file is read again."""
    video, found = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG), 0
    while video.grab():
        found += 1
    video.release()
    if found != count:
        raise OSError(errno.ENOSPC, f"only {found} of {count} frames could be written", str(path))


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
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    written = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    video.release()
    if written != frames:
        raise OSError(errno.ENOSPC, f"only {written} of {frames} video frames could be written")

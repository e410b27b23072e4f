"""Pictures out of a video file, one after the other; OpenCV's FFmpeg, or PyAV where installed."""

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import final

import cv2
import numpy as np
from jaxtyping import UInt8

from capture.decoder_av import PyAvDecoder
from capture.quiet import silence_opencv
from capture.shot import MAX_DECODE_FAILURES, VideoDecoder, DecoderFrame, unreadable_video_error


def open_decoder(path: Path) -> VideoDecoder:
    """PyAV's decoder if it is installed, which sees damage and knows HDR; else OpenCV's.

    Raises:
        InputError: If it is no video that can be opened.
    """
    if importlib.util.find_spec("av") is not None:
        return PyAvDecoder(path)
    return OpenCvDecoder(path)


def has_alpha_plane(tag: int) -> bool:
    """Whether pictures of a format, by FFmpeg's tag for it, have an alpha channel; -1: no format.

    OpenCV cannot read it. BGRA does not count: it is what OpenCV itself writes, always opaque.
    """
    name = (tag & 0xFFFFFFFF).to_bytes(4, "little")
    return name[:2] in (b"Y4", b"G4") or name in (b"RGBA", b"ARGB", b"ABGR")


@final
class OpenCvDecoder:
    """OpenCV's FFmpeg. It applies rotation flags, and does not tell which pictures are damaged."""

    knows_hdr = False

    def __init__(self, path: Path) -> None:
        """Opens the file once, to look at it.

        Raises:
            InputError: If it cannot be opened.
        """
        self._path = path
        capture = self._open()
        self.rate = capture.get(cv2.CAP_PROP_FPS)
        self.claimed = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        clockwise = round(capture.get(cv2.CAP_PROP_ORIENTATION_META) / 90.0)
        self.quarter_turns = -clockwise % 4
        kind = int(capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT))
        self.deep = (kind & 0xFFFF) == int.from_bytes(b"Y3", "little") and kind >> 24 in (10, 12)
        self.leaves_alpha = has_alpha_plane(kind)
        capture.release()

    def decode(self) -> Iterator[DecoderFrame]:
        """The pictures in order; every call starts anew."""
        capture, failures = self._open(), 0

        def rgb() -> UInt8[np.ndarray, "height width 3"] | None:
            ok, picture = capture.retrieve()
            return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB) if ok else None

        try:
            while failures < MAX_DECODE_FAILURES:
                if not capture.grab():
                    failures += 1
                    continue
                time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
                yield DecoderFrame(time_s=time_s, after_gap=failures > 0, corrupt=False, rgb=rgb)
                failures = 0
        finally:
            capture.release()

    def _open(self) -> cv2.VideoCapture:
        silence_opencv()
        capture = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG)
        if not capture.isOpened():
            raise unreadable_video_error(self._path)
        return capture

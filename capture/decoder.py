"""Pictures out of a video file, one after the other; OpenCV's FFmpeg, or PyAV where installed."""

import importlib.util
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, Protocol, final, runtime_checkable

import cv2
import numpy as np
from jaxtyping import UInt8

from capture.errors import BadInput
from capture.quiet import silence_opencv

PATIENCE = 16
"""How many failures in a row are the end: one damaged packet is none."""


class Shot(NamedTuple):
    """A picture at which the decoder stands.

    Attributes:
        time_s: The container's timestamp, from the first picture on.
        after_gap: Whether pictures before it could not be decoded.
        corrupt: Whether the decoder has patched it up.
        rgb: Decodes it, upright; None if that fails. To be called before the next shot is taken.
    """

    time_s: float
    after_gap: bool
    corrupt: bool
    rgb: Callable[[], UInt8[np.ndarray, "height width 3"] | None]


@runtime_checkable
class Decoder(Protocol):
    """An open video.

    Attributes:
        rate: Frames a second, as the container claims; 0 if it does not.
        claimed: How many frames there are, as the container claims; 0 or less if it does not.
        quarter_turns: How often its pictures are turned by 90° against the clock to stand upright.
        deep: Whether its pictures have more than 8 bits.
        knows_hdr: Whether HDR's highlights are kept.
    """

    rate: float
    claimed: int
    quarter_turns: int
    deep: bool
    knows_hdr: bool

    def shots(self) -> Iterator[Shot]:
        """The pictures in order; every call starts anew."""
        ...


def open_decoder(path: Path) -> Decoder:
    """PyAV's decoder if it is installed, which sees damage and knows HDR; else OpenCV's.

    Raises:
        BadInput: If it is no video that can be opened.
    """
    if importlib.util.find_spec("av") is not None:
        from capture.decoder_av import AvDecoder

        return AvDecoder(path)
    return CvDecoder(path)


def refusal(path: Path) -> BadInput:
    """What is said of a file that no decoder opens."""
    return BadInput(
        f"{path} is no video that can be opened. A recording that was cut off before "
        "it was finished has no index and cannot be read: copy it again from the camera."
    )


@final
class CvDecoder:
    """OpenCV's FFmpeg. It applies rotation flags, and does not tell which pictures are damaged."""

    knows_hdr = False

    def __init__(self, path: Path) -> None:
        """Opens the file once, to look at it.

        Raises:
            BadInput: If it cannot be opened.
        """
        self._path = path
        capture = self._open()
        self.rate = capture.get(cv2.CAP_PROP_FPS)
        self.claimed = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        clockwise = round(capture.get(cv2.CAP_PROP_ORIENTATION_META) / 90.0)
        self.quarter_turns = -clockwise % 4
        kind = int(capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT))
        self.deep = (kind & 0xFFFF) == int.from_bytes(b"Y3", "little") and kind >> 24 in (10, 12)
        capture.release()

    def shots(self) -> Iterator[Shot]:
        """The pictures in order; every call starts anew."""
        capture, failures = self._open(), 0

        def rgb() -> UInt8[np.ndarray, "height width 3"] | None:
            ok, picture = capture.retrieve()
            return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB) if ok else None

        try:
            while failures < PATIENCE:
                if not capture.grab():
                    failures += 1
                    continue
                time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
                yield Shot(time_s=time_s, after_gap=failures > 0, corrupt=False, rgb=rgb)
                failures = 0
        finally:
            capture.release()

    def _open(self) -> cv2.VideoCapture:
        silence_opencv()
        capture = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG)
        if not capture.isOpened():
            raise refusal(self._path)
        return capture

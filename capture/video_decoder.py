"""Decode a video file image by image, by PyAV where it is installed and else by OpenCV's FFmpeg.

PyAV (extra `[video]`) also reports damaged images and converts HDR to SDR.
"""

import importlib
import importlib.util
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Protocol, final, runtime_checkable

import cv2
import numpy as np
from jaxtyping import UInt8

from capture.hdr_video import HDR_TRANSFERS, tone_map_hdr
from capture.image_folder import has_cutout_alpha, refuse_pipe, silence_opencv
from capture.input_error import InputError

MAX_DECODE_FAILURES = 16
"""How many failures in a row are the end: one damaged packet is none."""


class DecoderFrame(NamedTuple):
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
class VideoDecoder(Protocol):
    """An open video.

    Attributes:
        fps: Frames per second, as the container claims; 0 if it does not.
        claimed_frames: Number of frames that the container claims; 0 or less if unknown.
        quarter_turns: Counter-clockwise quarter turns that make its images upright.
        is_high_bit_depth: Whether its images have more than 8 bits per channel.
        supports_hdr: Whether HDR's highlights are kept.
        has_unread_alpha: Whether its images have an alpha channel (known not to be opaque, by
            PyAV); it is not read.
        pixel_aspect: Width of a pixel by its height, as the container claims; 1 if it does not.
    """

    fps: float
    claimed_frames: int
    quarter_turns: int
    is_high_bit_depth: bool
    supports_hdr: bool
    has_unread_alpha: bool
    pixel_aspect: float

    def decode(self) -> Iterator[DecoderFrame]:
        """The pictures in order; every call starts from the first."""
        ...


def unreadable_video_error(path: Path) -> InputError:
    """Explain a file that no decoder opens."""
    return InputError(
        f"{path} is no video that can be opened; does it hold pictures, or sound "
        "alone? A recording that was cut off before "
        "it was finished has no index and cannot be read: copy it again from the camera."
    )


def import_pyav() -> Any:
    """The module, which is an extra: nothing is loaded where it is not used."""
    return importlib.import_module("av")


@final
class PyAvDecoder:
    """FFmpeg by PyAV; for 8 bits the same pixels as OpenCV's."""

    supports_hdr = True

    def __init__(self, path: Path) -> None:
        """Opens the file once, to look at it, and decodes a picture.

        Raises:
            InputError: If it cannot be opened, or holds no video.
        """
        self._path = path
        av = import_pyav()
        try:
            with av.open(str(path)) as container:
                stream = container.streams.video[0]
                self.fps = float(stream.average_rate or 0.0)
                lasts_s = (container.duration or 0) / import_pyav().time_base
                self.claimed_frames = int(stream.frames) or round(lasts_s * self.fps)
                self.pixel_aspect = float(stream.sample_aspect_ratio or 1.0)
                self.is_high_bit_depth = stream.codec_context.pix_fmt in HIGH_BIT_DEPTH_FORMATS
                first = next(self._frames(container, stream), None)
                self.has_unread_alpha = first is not None and _has_transparency(first[0])
        except (av.FFmpegError, IndexError, ValueError, OSError) as cause:
            raise unreadable_video_error(path) from cause
        self.quarter_turns = 0 if first is None else int(first[0].rotation) // 90 % 4

    def decode(self) -> Iterator[DecoderFrame]:
        """The pictures in order; every call starts from the first."""
        with import_pyav().open(str(self._path)) as container:
            stream = container.streams.video[0]
            start = stream.start_time or 0
            for frame, after_gap in self._frames(container, stream):
                ticks = 0 if frame.pts is None else frame.pts - start

                def rgb(frame: Any = frame) -> UInt8[np.ndarray, "height width 3"] | None:
                    return _decode_upright(frame)

                yield DecoderFrame(
                    time_s=float(ticks * stream.time_base),
                    after_gap=after_gap,
                    corrupt=bool(frame.is_corrupt),
                    rgb=rgb,
                )

    def _frames(self, container: Any, stream: Any) -> Iterator[tuple[Any, bool]]:
        """Frames, and whether something before each could not be decoded."""
        stream.thread_type = "AUTO"
        packets, failures = container.demux(stream), 0
        while failures < MAX_DECODE_FAILURES:
            try:
                frames = next(packets).decode()
            except StopIteration:
                return
            except import_pyav().FFmpegError:
                failures += 1
                continue
            for frame in frames:
                yield frame, failures > 0
                failures = 0


HIGH_BIT_DEPTH_FORMATS = frozenset(
    {"yuv420p10le", "yuv422p10le", "yuv444p10le", "p010le", "yuv420p12le", "yuv422p12le"}
)
"""FFmpeg's names of pictures of more than 8 bits, as phones and cameras write them."""


def _has_transparency(frame: Any) -> bool:
    """Whether a frame has an alpha channel that is not opaque."""
    if not any(component.is_alpha for component in frame.format.components):
        return False
    return has_cutout_alpha(frame.to_ndarray(format="rgba")[..., 3])


def _decode_upright(frame: Any) -> UInt8[np.ndarray, "height width 3"] | None:
    try:
        if int(frame.color_trc) in HDR_TRANSFERS:
            rgb = tone_map_hdr(frame.to_ndarray(format="rgb48le"), int(frame.color_trc))
        else:
            rgb = frame.to_ndarray(format="rgb24")
    except (import_pyav().FFmpegError, ValueError):
        return None
    return np.ascontiguousarray(np.rot90(rgb, int(frame.rotation) // 90))


def open_decoder(path: Path) -> VideoDecoder:
    """PyAV's decoder if it is installed, which sees damage and knows HDR; else OpenCV's.

    Raises:
        InputError: If it is no video that can be opened, or no file.
    """
    refuse_pipe(path)
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

    supports_hdr = False

    def __init__(self, path: Path) -> None:
        """Opens the file once, to look at it.

        Raises:
            InputError: If it cannot be opened.
        """
        self._path = path
        capture = self._open()
        self.fps = capture.get(cv2.CAP_PROP_FPS)
        self.claimed_frames = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        clockwise = round(capture.get(cv2.CAP_PROP_ORIENTATION_META) / 90.0)
        self.quarter_turns = -clockwise % 4
        kind = int(capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT))
        self.is_high_bit_depth = (kind & 0xFFFF) == int.from_bytes(
            b"Y3", "little"
        ) and kind >> 24 in (10, 12)
        self.has_unread_alpha = has_alpha_plane(kind)
        wide, high = capture.get(cv2.CAP_PROP_SAR_NUM), capture.get(cv2.CAP_PROP_SAR_DEN)
        self.pixel_aspect = wide / high if wide > 0.0 and high > 0.0 else 1.0
        capture.release()

    def decode(self) -> Iterator[DecoderFrame]:
        """The pictures in order; every call starts from the first."""
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

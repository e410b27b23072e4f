"""Decode a video file image by image, by PyAV where it is installed and else by OpenCV's FFmpeg.

PyAV (extra `[video]`) also reports damaged images; its HDR images are mapped to 8-bit sRGB.
"""

import importlib
import importlib.util
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol, final, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from capture.image_folder import has_cutout_alpha, refuse_pipe, silence_opencv
from capture.input_error import InputError

PQ = 16
"""Transfer characteristics of SMPTE ST 2084 (code of ITU-T H.273)."""

HLG = 18
"""Transfer characteristics of ARIB STD-B67 (code of ITU-T H.273)."""

HDR_TRANSFERS = frozenset({PQ, HLG})
"""Codes of all HDR transfer curves."""

WHITE_NITS = 203.0
"""Luminance of diffuse white in HDR (ITU-R BT.2408), which maps to white; cd/m²."""

PEAK_NITS = 1000.0
"""Luminance of the brightest highlight that stays distinct; cd/m²."""

TONE_MAP_KNEE = 0.75
"""Fraction of white from which light is compressed, so that the peak becomes white."""

MAX_MOOV_BYTES = 64 << 20
"""Most bytes of a file's index that are searched."""

BT709_FROM_BT2020 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)
"""Linear BT.709 from linear BT.2020 (ITU-R BT.2087)."""

LUT_SIZE = 4096
"""Entries of the table from code values to linear light (12 bits)."""


def read_hdr_transfer(path: Path) -> int | None:
    """The HDR transfer curve that an .mp4 or .mov states in its index; None without one.

    Read from the `colr` box (ISO 14496-12): "nclx" or "nclc", primaries, transfer, matrix.
    """
    index = _read_moov(path)
    at = index.find(b"colr")
    while at >= 0:
        if index[at + 4 : at + 8] in (b"nclx", b"nclc"):
            curve = int.from_bytes(index[at + 10 : at + 12], "big")
            return curve if curve in HDR_TRANSFERS else None
        at = index.find(b"colr", at + 4)
    return None


def _read_moov(path: Path) -> bytes:
    """The `moov` box of a file; empty if it has none."""
    with path.open("rb") as file:
        while len(head := file.read(8)) == 8:
            size, kind, skipped = int.from_bytes(head[:4], "big"), head[4:], 8
            if size == 1:
                size, skipped = int.from_bytes(file.read(8), "big"), 16
            if kind == b"moov":
                return file.read(min(max(size - skipped, 0), MAX_MOOV_BYTES))
            if size < skipped:
                return b""
            file.seek(size - skipped, 1)
    return b""


def tone_map_hdr(
    rgb: UInt16[np.ndarray, "height width 3"], curve: int
) -> UInt8[np.ndarray, "height width 3"]:
    """8-bit sRGB of a 16-bit picture in BT.2020 with an HDR curve.

    Light is linearised, white scaled to `WHITE_NITS` and colors converted to BT.709; above the knee
    all three channels are compressed by one factor, which preserves hues.
    """
    light = np.take(_linear_light_lut(curve), rgb >> 4)
    if curve == HLG:  # the display's gamma of 1.2 for the luminance (ITU-R BT.2100)
        luma = light @ np.array([0.2627, 0.6780, 0.0593], np.float32)
        light *= np.power(np.maximum(luma, 1e-6), np.float32(0.2))[..., None]
    light *= np.float32(PEAK_NITS / WHITE_NITS)
    light = cv2.transform(light, BT709_FROM_BT2020)
    brightest = np.maximum(light.max(axis=-1), np.float32(1e-6))
    light *= (_compress_highlights(brightest) / brightest)[..., None]
    codes = np.clip(light * np.float32(LUT_SIZE - 1), 0.0, LUT_SIZE - 1).astype(np.uint16)
    return np.take(_srgb_lut(), codes)


def _compress_highlights(light: Float32[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    """Light up to the knee as it is, and the rest on a smooth curve that ends at the peak in 1.

    y = k + r t / (1 + t (1 - r / s)) with t = (x - k) / r, r = 1 - k and s = peak - k: slope 1 at
    the knee, 1 at the peak.
    """
    room, span = 1.0 - TONE_MAP_KNEE, PEAK_NITS / WHITE_NITS - TONE_MAP_KNEE
    t = (light - np.float32(TONE_MAP_KNEE)) / np.float32(room)
    bent = TONE_MAP_KNEE + room * t / (1.0 + t * (1.0 - room / span))
    return np.where(t > 0.0, np.minimum(bent, 1.0), light).astype(np.float32)


@cache
def _linear_light_lut(curve: int) -> Float32[np.ndarray, "4096"]:
    """Linear light of each code, 1 at the peak of 1,000 nits."""
    code = np.linspace(0.0, 1.0, LUT_SIZE)
    if curve == HLG:
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        light = np.where(code <= 0.5, code**2 / 3.0, (np.exp((code - c) / a) + b) / 12.0)
    else:
        m1, m2, c1, c2, c3 = 0.1593017578125, 78.84375, 0.8359375, 18.8515625, 18.6875
        root = code ** (1.0 / m2)
        light = 10000.0 * (np.maximum(root - c1, 0.0) / (c2 - c3 * root)) ** (1.0 / m1)
        light = np.minimum(light / PEAK_NITS, 1.0)
    return light.astype(np.float32)


@cache
def _srgb_lut() -> UInt8[np.ndarray, "4096"]:
    light = np.linspace(0.0, 1.0, LUT_SIZE)
    code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    return np.round(255.0 * code).astype(np.uint8)


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

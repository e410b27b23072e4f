"""Video files, read by PyAV as upright RGB frames with the container's timestamps."""

from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import av
import cv2
import numpy as np
from av.error import FFmpegError
from jaxtyping import Float32, UInt8, UInt16

from capture.image_folder import refuse_pipe
from capture.input_error import InputError, counted, quote_command
from capture.source import Frame, FrameSelection, FrameSource, RgbImage, shrink_to_longer_side

VIDEO_SUFFIXES = frozenset(
    {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".3gp", ".ts", ".wmv"}
)
"""File endings of videos that are read."""


class DecodedFrame(NamedTuple):
    """A frame as the decoder yields it, not converted to RGB yet.

    `time_s` is counted from the first frame on; `after_gap` tells whether frames before it could
    not be decoded.
    """

    frame: Any
    time_s: float
    after_gap: bool

    def rgb(self, longer_px: int | None = None) -> RgbImage | None:
        """Convert to upright 8-bit RGB, reduced to a longer side first; None if that fails."""
        frame, curve = self.frame, int(self.frame.color_trc)
        width, height = shrink_to_longer_side((frame.width, frame.height), longer_px)
        is_hdr = curve in HDR_TRANSFERS
        kind = "rgb48le" if is_hdr else "rgb24"
        try:
            rgb = frame.to_ndarray(format=kind, width=width, height=height)
            rgb = tone_map_hdr(rgb, curve) if is_hdr else rgb
        except (FFmpegError, ValueError):
            return None
        return np.ascontiguousarray(np.rot90(rgb, quarter_turns(self.frame)))

    @property
    def flags(self) -> frozenset[str]:
        """Those of `Frame`: a frame after a gap was predicted from one that is lost."""
        return frozenset({"corrupt"} if self.after_gap or self.frame.is_corrupt else ())


class VideoFile(FrameSource):
    """A recorded video; its rotation tag is applied and HDR is tone mapped.

    A file that ends early or has gaps is read as far as it goes, with a warning.
    """

    def __init__(self, path: Path, selection: FrameSelection) -> None:
        """Open the file and decode one frame."""
        super().__init__(path, selection)
        refuse_pipe(path)
        try:
            with av.open(str(path)) as container:
                stream = container.streams.video[0]
                self._fps = float(stream.average_rate or 0.0)
                duration_s = (container.duration or 0) / av.time_base
                claimed_frames = int(stream.frames) or round(duration_s * self._fps)
                pixel_aspect = float(stream.sample_aspect_ratio or 1.0)
                first = next(decode(container, stream), None)
        except IndexError as cause:
            raise InputError(f"{path} holds no images, only sound or text.") from cause
        except (FFmpegError, ValueError, OSError) as cause:
            if path.is_file() and not path.stat().st_size:
                raise InputError(f"{path} is empty (0 bytes): copy it again.") from cause
            raise InputError(
                f"{path} cannot be opened as a video. A recording that was cut off before it was "
                "finished has no index and cannot be read: copy it again from the camera."
            ) from cause
        if first is None:
            raise InputError(f"No frame of {path} could be decoded; the video is empty or damaged.")
        self.is_hdr = int(first.frame.color_trc) in HDR_TRANSFERS
        width, height = int(first.frame.width), int(first.frame.height)
        self.size_px = (height, width) if quarter_turns(first.frame) % 2 else (width, height)
        self.frames_in_file = claimed_frames if claimed_frames > 0 else self.count_frames()
        self.frame_count = selection.count(self.frames_in_file)
        span = selection.span(self.frames_in_file)
        self.duration_s = span / self._fps if self._fps > 0.0 else None
        if not self.frame_count:
            raise InputError(
                f"{path} has {counted(self.frames_in_file, 'frame')}; none of them is "
                f"among the frames asked for, which start at {selection.start}."
            )
        self._warn_of_wide_pixels(pixel_aspect)

    def frames(self) -> Iterator[Frame]:
        """Yield the selected frames in order; every call starts from the first."""
        for index, decoded in self.numbered():
            if not self.selection.contains(index):
                continue
            rgb = decoded.rgb()
            if rgb is None or rgb.shape[1::-1] != self.size_px:
                self._warn(f"Frame {index} of {self.path.name} could not be decoded; left out.")
                continue
            yield Frame(index=index, time_s=decoded.time_s, rgb=rgb, flags=decoded.flags)

    def glance(
        self, times_s: Sequence[float], apart_s: float, longer_px: int
    ) -> Iterator[tuple[Frame, Frame]]:
        """Yield reduced frames near some times, each with one that comes `apart_s` later.

        What lies between is skipped from key frame to key frame, where the container lists them.
        """
        slack_s = 0.5 * (times_s[-1] - times_s[0]) / max(1, len(times_s) - 1)
        with av.open(str(self.path)) as container:
            stream: Any = container.streams.video[0]
            entries, start = stream.index_entries, stream.start_time or 0
            keys = np.array([entry.timestamp for entry in entries if entry.is_keyframe])
            keys_s = (keys - start) * float(stream.time_base)
            frames, now_s = decode(container, stream), -1.0
            for time_s in times_s:
                near = np.flatnonzero((keys_s > now_s) & (keys_s <= time_s))
                if len(near):
                    container.seek(int(keys[near[-1]]), stream=stream)
                first = self._next_reduced(frames, time_s - slack_s, longer_px)
                later_s = np.inf if first is None else first.time_s + apart_s
                second = self._next_reduced(frames, later_s, longer_px)
                if first is None or second is None:
                    return
                now_s = second.time_s
                yield first, second

    def _next_reduced(
        self, frames: Iterator[DecodedFrame], time_s: float, longer_px: int
    ) -> Frame | None:
        """The next frame that does not come before a time, reduced."""
        for decoded in frames:
            if decoded.time_s >= time_s and (rgb := decoded.rgb(longer_px)) is not None:
                index = round(decoded.time_s * self._fps)
                return Frame(index=index, time_s=decoded.time_s, rgb=rgb)
        return None

    def count_frames(self) -> int:
        """Count the frames that can be decoded, by decoding them."""
        return sum(1 for _ in self._decode_all())

    def numbered(self) -> Iterator[tuple[int, DecodedFrame]]:
        """Yield each frame with its number; where some are lost, an even rate tells how many."""
        index, count, even, time_s, damaged = 0, 0, True, 0.0, 0
        for decoded in self._decode_all():
            if self.selection.is_past_end(index):
                return
            time_s = decoded.time_s
            position = time_s * self._fps
            if decoded.after_gap and even:
                index = max(index, round(position))
            even = even and abs(position - index) < 0.3
            damaged += bool(decoded.frame.is_corrupt)
            yield index, decoded
            index, count = index + 1, count + 1
        if not self.selection.is_past_end(index):
            self._compare_with_claim(count, time_s)
        if damaged:
            self._warn(
                f"{self.path.name}: {counted(damaged, 'damaged frame')} of {count}; left out."
            )

    def _decode_all(self) -> Iterator[DecodedFrame]:
        with av.open(str(self.path)) as container:
            yield from decode(container, container.streams.video[0])

    def _compare_with_claim(self, count: int, end_s: float) -> None:
        """Warn if the container claims more than was decoded."""
        # other containers estimate the count from the duration
        counted = self.path.suffix.lower() in {".mp4", ".mov", ".m4v", ".avi", ".3gp"}
        duration_s = self.frames_in_file / max(self._fps, 1e-6)
        if counted and count < self.frames_in_file:
            decoded = f"only {count} of {self.frames_in_file} frames could be decoded"
        elif not counted and end_s < 0.95 * duration_s - 0.5:
            decoded = f"only {end_s:.1f} of {duration_s:.1f} s could be decoded"
        else:
            return
        self._warn(f"{self.path.name}: {decoded}; the file is truncated or damaged.")

    def _warn_of_wide_pixels(self, aspect: float) -> None:
        """Warn of pixels that players stretch: images are taken as they are stored."""
        if abs(aspect - 1.0) > 0.02:
            kind = "narrow" if aspect > 1.0 else "broad"
            self._warn(
                f"{self.path.name} has pixels that are not square ({aspect:.2f}:1): the person is "
                f"too {kind} in them, and so is the avatar. Convert the video first: ffmpeg -i "
                f"{quote_command(self.path.name)} -vf scale=iw*sar:ih,setsar=1 square.mp4"
            )


def decode(container: Any, stream: Any, *, at_once: bool = False) -> Iterator[DecodedFrame]:
    """Yield the frames of a stream; those that fail to decode are skipped.

    With `at_once` no frame waits for the next ones, which other threads would decode beside it.
    """
    stream.thread_type = "SLICE" if at_once else "AUTO"
    packets, failures = container.demux(stream), 0
    start = stream.start_time or 0
    while failures < 16:  # one damaged packet does not end a video
        try:
            frames = next(packets).decode()
        except StopIteration:
            return
        except FFmpegError:
            failures += 1
            continue
        for frame in frames:
            ticks = 0 if frame.pts is None else frame.pts - start
            yield DecodedFrame(frame, float(ticks * stream.time_base), failures > 0)
            failures = 0


def quarter_turns(frame: Any) -> int:
    """Return the counter-clockwise quarter turns that make a frame upright."""
    return int(frame.rotation) // 90 % 4


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
BT709_FROM_BT2020 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)
"""Linear BT.709 from linear BT.2020 (ITU-R BT.2087)."""
STRIP_ROWS = 16
"""Rows that are converted at once: those of a 4K image stay in the processor's cache."""
LUT_SIZE = 4096
"""Entries of the table from code values to linear light (12 bits)."""


def tone_map_hdr(rgb: UInt16[np.ndarray, "height width 3"], curve: int) -> RgbImage:
    """8-bit sRGB of a 16-bit image in BT.2020 with an HDR curve.

    Light is linearised, white scaled to `WHITE_NITS` and colors converted to BT.709; above the knee
    all three channels are compressed by one factor, which preserves hues.
    """
    strips = range(0, len(rgb), STRIP_ROWS)
    return np.concatenate([_tone_map_strip(rgb[top : top + STRIP_ROWS], curve) for top in strips])


def _tone_map_strip(
    rgb: UInt16[np.ndarray, "rows width 3"], curve: int
) -> UInt8[np.ndarray, "rows width 3"]:
    light = np.take(_linear_light_lut(curve), rgb >> 4)
    if curve == HLG:  # the display's gamma of 1.2 for the luminance (ITU-R BT.2100)
        luma = light @ np.array([0.2627, 0.6780, 0.0593], np.float32)
        light *= np.power(np.maximum(luma, 1e-6), 0.2)[..., None]
    light *= PEAK_NITS / WHITE_NITS
    light = cv2.transform(light, BT709_FROM_BT2020)
    brightest = np.maximum(light[..., 0], np.maximum(light[..., 1], light[..., 2]))
    brightest = np.maximum(brightest, 1e-6)
    light *= (_compress_highlights(brightest) / brightest)[..., None]
    codes = np.clip(light * (LUT_SIZE - 1), 0.0, LUT_SIZE - 1).astype(np.uint16)
    return np.take(_srgb_lut(), codes)


def _compress_highlights(light: Float32[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    """Light up to the knee as it is, and the rest on a smooth curve that ends at the peak in 1.

    y = k + r t / (1 + t (1 - r / s)) with t = (x - k) / r, r = 1 - k and s = peak - k: slope 1 at
    the knee, 1 at the peak.
    """
    room, span = 1.0 - TONE_MAP_KNEE, PEAK_NITS / WHITE_NITS - TONE_MAP_KNEE
    t = (light - TONE_MAP_KNEE) / room
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

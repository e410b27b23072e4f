"""Video files: read as upright frames with the container's timestamps, and written from pictures.

Damage is reported. H.264 and VP9 are written by PyAV where it is installed, else by what OpenCV
can; lossless video (FFV1) is OpenCV's.
"""

import errno
import importlib
import importlib.util
import os
import shlex
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
from capture.source import Frame, FrameSelection, Recording
from capture.video_decoder import DecoderFrame, open_decoder, read_hdr_transfer

VIDEO_SUFFIXES = frozenset(
    {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".3gp", ".ts", ".wmv"}
)
"""File endings of videos that are read."""

CONTAINERS_WITH_FRAME_COUNT = frozenset({".mp4", ".mov", ".m4v", ".avi", ".3gp"})
"""Containers that count their frames; of others the count is an estimate from the duration."""

MAX_PIXEL_STRETCH = 0.02
"""Relative difference of a pixel's width and height from which it is worth a word."""


class VideoFile(Recording):
    """A recorded video, whose rotation flag is applied.

    A file that ends early or has gaps is read as far as it goes, with a warning. Known limit:
    without PyAV it is unknown which images FFmpeg has concealed damage in.

    Attributes:
        quarter_turns: Counter-clockwise quarter turns that make its stored images upright.
        has_unread_alpha: Whether it has an alpha channel; it is not read (pictures' are).
    """

    has_alpha = False

    def __init__(self, path: Path, selection: FrameSelection) -> None:
        """Opens the file and decodes one frame.

        Raises:
            InputError: If no frame can be decoded, or none is wanted.
        """
        super().__init__(path, selection)
        self._decoder = open_decoder(path)
        self.quarter_turns = self._decoder.quarter_turns
        self.has_unread_alpha = self._decoder.has_unread_alpha
        self._fps = self._decoder.fps
        picture = next((shot.rgb() for shot in self._decoder.decode()), None)
        if picture is None:
            raise InputError(f"No frame of {path} could be decoded; the video is empty or damaged.")
        self.size_px = (int(picture.shape[1]), int(picture.shape[0]))
        claimed = self._decoder.claimed_frames
        self.frames_in_file = claimed if claimed > 0 else self.count_frames()
        self.frame_count: int | None = selection.count(self.frames_in_file)
        span = selection.span(self.frames_in_file)
        self.duration_s: float | None = span / self._fps if self._fps > 0.0 else None
        if not self.frame_count:
            raise InputError(
                f"{path} has {self.frames_in_file} frames; none of them is among the frames asked "
                f"for, which start at {selection.start}."
            )
        self._warn_of_hdr()
        self._warn_of_wide_pixels()

    def frames(self) -> Iterator[Frame]:
        """The wanted frames in order; every call starts from the first."""
        previous = None
        for index, shot in self._numbered():
            if not self.selection.contains(index):
                continue
            rgb = shot.rgb()
            if rgb is None or rgb.shape[1::-1] != self.size_px:
                self._warn(f"Frame {index} of {self.path.name} could not be decoded; left out.")
                continue
            flags = _frame_flags(rgb, previous, shot)
            yield Frame(index=index, time_s=shot.time_s, rgb=rgb, flags=flags)
            previous = rgb

    def count_frames(self) -> int:
        """How many frames can be decoded, found by doing so."""
        return sum(1 for _ in self._decoder.decode())

    def _numbered(self) -> Iterator[tuple[int, DecoderFrame]]:
        """Every picture with its number; where some are lost, an even rate tells how many."""
        index, got, even, time_s, damaged = 0, 0, True, 0.0, 0
        for shot in self._decoder.decode():
            if self.selection.is_past_end(index):
                return
            time_s = shot.time_s
            place = time_s * self._fps
            if shot.after_gap and even:
                index = max(index, round(place))
            even = even and abs(place - index) < 0.3
            damaged += shot.corrupt
            yield index, shot
            index, got = index + 1, got + 1
        if not self.selection.is_past_end(index):
            self._compare_with_claim(got, time_s)
        if damaged:
            self._warn(f"{self.path.name}: {damaged} of {got} frames are damaged; left out.")

    def _compare_with_claim(self, got: int, end_s: float) -> None:
        """Warns if the container promised more than came."""
        counted = self.path.suffix.lower() in CONTAINERS_WITH_FRAME_COUNT
        duration_s = self.frames_in_file / max(self._fps, 1e-6)
        if counted and got < self.frames_in_file:
            came = f"only {got} of {self.frames_in_file} frames could be decoded"
        elif not counted and end_s < 0.95 * duration_s - 0.5:
            came = f"only {end_s:.1f} of {duration_s:.1f} s could be decoded"
        else:
            return
        self._warn(f"{self.path.name}: {came}; the file is truncated or damaged.")

    def _warn_of_hdr(self) -> None:
        """HDR without PyAV comes slowly, and its highlights are cut off."""
        if not self._decoder.is_high_bit_depth or self._decoder.supports_hdr:
            return
        tells = self.path.suffix.lower() in CONTAINERS_WITH_FRAME_COUNT
        if tells and read_hdr_transfer(self.path) is None:
            return
        kind = "an HDR video" if tells else "a 10-bit video, perhaps HDR"
        self._warn(
            f"{self.path.name} is {kind}: it is decoded slowly, and highlights are cut off. Film "
            "with HDR off, or install PyAV: pip install 'instant-avatar-stream[video]'."
        )

    def _warn_of_wide_pixels(self) -> None:
        """Images are taken as they are stored; players stretch them."""
        aspect = self._decoder.pixel_aspect
        if abs(aspect - 1.0) > MAX_PIXEL_STRETCH:
            kind = "narrow" if aspect > 1.0 else "broad"
            self._warn(
                f"{self.path.name} has pixels that are not square ({aspect:.2f}:1): the person is "
                f"too {kind} in them, and so is the avatar. Convert the video first: ffmpeg -i "
                f"{shlex.quote(self.path.name)} -vf scale=iw*sar:ih,setsar=1 square.mp4"
            )


def _frame_flags(
    rgb: UInt8[np.ndarray, "height width 3"],
    previous: UInt8[np.ndarray, "height width 3"] | None,
    shot: DecoderFrame,
) -> frozenset[str]:
    """A picture after a gap was predicted from one that is lost."""
    same = previous is not None and np.array_equal(rgb, previous)
    damaged = shot.after_gap or shot.corrupt
    return frozenset({"repeated"} if same else ()) | frozenset({"corrupt"} if damaged else ())


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

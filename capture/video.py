"""A video file as frames: upright, with the container's timestamps, and honest about damage."""

import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

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

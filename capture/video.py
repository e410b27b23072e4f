"""A video file as frames: upright, with the container's timestamps, and honest about damage."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from capture.errors import BadInput
from capture.frame import Frame
from capture.quiet import silence_opencv
from capture.selection import Selection

COUNTED = frozenset({".mp4", ".mov", ".m4v", ".avi", ".3gp"})
"""Containers that count their frames; of others the count is an estimate from the duration."""

PATIENCE = 16
"""How many failures in a row are the end: one damaged packet is none."""


class VideoFile:
    """A recorded video (OpenCV's FFmpeg; rotation flags are applied).

    A file that ends early or has gaps is read as far as it goes, with a warning. Known limit:
    OpenCV does not tell which pictures FFmpeg has patched up from damaged data.
    """

    has_alpha = False
    live = False
    paced = False
    started_at = 0.0
    waited_s = 0.0
    dropped = 0

    def __init__(self, path: Path, selection: Selection) -> None:
        """Opens the file and decodes one frame.

        Raises:
            BadInput: If no frame can be decoded, or none is wanted.
        """
        self.path = path
        self.selection = selection
        self.warnings: list[str] = []
        capture = self._open()
        ok, picture = capture.read()
        if not ok:
            raise BadInput(f"No frame of {path} could be decoded; the video is empty or damaged.")
        self.size_px = (int(picture.shape[1]), int(picture.shape[0]))
        self._rate = capture.get(cv2.CAP_PROP_FPS)
        claimed = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        capture.release()
        self.frames_in_file = claimed if claimed > 0 else self.count_frames()
        self.frame_count: int | None = selection.count(self.frames_in_file)
        span = selection.span(self.frames_in_file)
        self.duration_s: float | None = span / self._rate if self._rate > 0.0 else None
        if not self.frame_count:
            raise BadInput(
                f"{path} has {self.frames_in_file} frames; none of them is among the frames asked "
                f"for, which start at {selection.start}."
            )

    def frames(self) -> Iterator[Frame]:
        """The wanted frames in order; every call starts anew."""
        previous = None
        for index, time_s, capture, after_gap in self._pictures():
            if not self.selection.wants(index):
                continue
            ok, picture = capture.retrieve()
            if not ok or picture.shape[1::-1] != self.size_px:
                self._warn(f"Frame {index} of {self.path.name} could not be decoded; left out.")
                continue
            rgb = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
            yield Frame(index=index, time_s=time_s, rgb=rgb, flags=_flags(rgb, previous, after_gap))
            previous = rgb

    def count_frames(self) -> int:
        """How many frames can be decoded, found by doing so."""
        capture, count, failures = self._open(), 0, 0
        while failures < PATIENCE:
            failures = 0 if capture.grab() else failures + 1
            count += not failures
        capture.release()
        return count

    def close(self) -> None:
        """Nothing is held open but by `frames()`, which lets it go itself."""

    def _pictures(self) -> Iterator[tuple[int, float, cv2.VideoCapture, bool]]:
        """Number and time of every picture while the decoder stands at it; if it follows a gap."""
        capture, index, got, failures, even = self._open(), 0, 0, 0, True
        time_s = 0.0
        try:
            while failures < PATIENCE and not self.selection.over(index):
                if not capture.grab():
                    failures += 1
                    continue
                time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
                place = time_s * self._rate
                if failures and even:  # pictures may be lost here; an even rate tells how many
                    index = max(index, round(place))
                even = even and abs(place - index) < 0.3
                yield index, time_s, capture, failures > 0
                index, got, failures = index + 1, got + 1, 0
        finally:
            capture.release()
        if not self.selection.over(index):
            self._compare_with_claim(got, time_s)

    def _compare_with_claim(self, got: int, end_s: float) -> None:
        """Warns if the container promised more than came."""
        counted = self.path.suffix.lower() in COUNTED
        duration_s = self.frames_in_file / max(self._rate, 1e-6)
        if counted and got < self.frames_in_file:
            came = f"only {got} of {self.frames_in_file} frames could be decoded"
        elif not counted and end_s < 0.95 * duration_s - 0.5:
            came = f"only {end_s:.1f} of {duration_s:.1f} s could be decoded"
        else:
            return
        self._warn(f"{self.path.name}: {came}; the file is truncated or damaged.")

    def _open(self) -> cv2.VideoCapture:
        silence_opencv()
        capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        if not capture.isOpened():
            raise BadInput(
                f"{self.path} is no video that can be opened. A recording that was cut off before "
                "it was finished has no index and cannot be read: copy it again from the camera."
            )
        return capture

    def _warn(self, message: str) -> None:
        if message not in self.warnings:
            self.warnings.append(message)


def _flags(
    rgb: UInt8[np.ndarray, "height width 3"],
    previous: UInt8[np.ndarray, "height width 3"] | None,
    after_gap: bool,
) -> frozenset[str]:
    """A picture after a gap was predicted from one that is lost."""
    same = previous is not None and np.array_equal(rgb, previous)
    return frozenset({"repeated"} if same else ()) | frozenset({"corrupt"} if after_gap else ())

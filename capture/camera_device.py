"""A camera as frames: its own thread reads, the latest pictures are kept, older ones give way."""

import errno
import os
import re
import threading
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import final

import cv2
import numpy as np
from jaxtyping import UInt8

from capture.image_folder import silence_opencv
from capture.input_error import InputError
from capture.source import Frame, FrameSelection, PacingClock

CAMERA_PREFIX = "camera:"
"""Start of an argument that names a camera instead of a file."""

MAX_QUEUED_FRAMES = 16
"""Most frames that wait, so that one whose pose is late does not cost the next ones."""

MAX_READ_FAILURES = 16
"""Consecutive failures that mean the end: the camera was unplugged, or the stream is over."""


def camera_address(path: Path) -> str | None:
    """What follows `camera:` in an argument; None if it names no camera."""
    text = str(path)
    if not text.startswith(CAMERA_PREFIX):
        return None
    return re.sub(r"^(\w+):/(?!/)", r"\1://", text.removeprefix(CAMERA_PREFIX))  # paths fold "//"


@final
class CameraDevice:
    """A live source: a camera's number, a device, the address of a stream, or a file like one.

    A file is read at its own pace, as if it came from a camera; so can be tried what will be done.

    Attributes:
        dropped: How many pictures gave way to later ones.
        started_at: When the first picture came, in seconds since 1970.
    """

    has_alpha = False
    quarter_turns = 0
    live = paced = True
    frames_in_file = 0
    frame_count: int | None = None
    duration_s: float | None = None

    def __init__(self, address: str, selection: FrameSelection, pace: PacingClock) -> None:
        """Opens it and waits for its first picture.

        Args:
            address: What follows `camera:`.
            selection: Which pictures are wanted.
            pace: By which others wait for what belongs to its pictures; closing ends it.

        Raises:
            InputError: If there is no such camera.
            OSError: If it is there and cannot be used now (EBUSY), or may not be (EACCES).
        """
        self.path = Path(CAMERA_PREFIX + address)
        self.selection = selection
        self.warnings: list[str] = []
        self.dropped = 0
        self._pace, self._waited_s = pace, 0.0
        self._is_file = Path(address).is_file()
        self._capture = _open_device(address)
        ok, picture = self._capture.read()
        if not ok:
            self._capture.release()
            raise OSError(errno.EBUSY, "it is open but gives no picture", str(self.path))
        self.size_px = (int(picture.shape[1]), int(picture.shape[0]))
        self.started_at = time.time()
        self._first_at = time.perf_counter()
        self._waiting: deque[Frame] = deque([self._frame(0, self._first_at, picture)])
        self._changed = threading.Condition()
        self._ended = False
        self._reader: threading.Thread | None = None

    @property
    def waited_s(self) -> float:
        """How long it has been waited for pictures, and for what belongs to them."""
        return self._waited_s + self._pace.waited_s

    def frames(self) -> Iterator[Frame]:
        """The pictures as they come; to be read once."""
        if self._reader is None:
            self._reader = threading.Thread(target=self._read, daemon=True)
            self._reader.start()
        while (frame := self._next()) is not None:
            if self.selection.is_past_end(frame.index):
                return
            if self.selection.contains(frame.index):
                yield frame

    def count_frames(self) -> int:
        """Return 0: the length of a live source is unknown."""
        return 0

    def close(self) -> None:
        """Lets the camera go."""
        self._pace.stop()
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        if self._reader is not None:
            self._reader.join(timeout=2.0)  # a stuck driver must not hold what was learnt
        if self._reader is None or not self._reader.is_alive():
            self._capture.release()

    def _next(self) -> Frame | None:
        """The oldest picture that waits; None at the end."""
        with self._changed:
            began = time.perf_counter()
            while not (self._waiting or self._ended):
                self._changed.wait(0.1)
            self._waited_s += time.perf_counter() - began
            return self._waiting.popleft() if self._waiting and not self._pace.stopped else None

    def _read(self) -> None:
        """Takes pictures as fast as they come; runs on its own thread."""
        try:
            count = 1 + self._read_all()
            if not (self._ended or self._is_file):
                self.warnings.append(
                    f"{self.path} gave no more pictures after {count}; was it unplugged? What was "
                    "learnt until then is kept."
                )
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _read_all(self) -> int:
        """The number of the last picture."""
        index, failures = 0, 0
        while failures < MAX_READ_FAILURES and not self._ended:
            if not self._capture.grab():
                failures += 1
                continue
            index, failures = index + 1, 0
            if self._is_file:
                due = self._first_at + self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
                time.sleep(max(0.0, due - time.perf_counter()))
            now = time.perf_counter()
            ok, picture = self._capture.retrieve()
            if ok and picture.shape[1::-1] == self.size_px:
                self._put(self._frame(index, now, picture))
        return index

    def _put(self, frame: Frame) -> None:
        with self._changed:
            if len(self._waiting) == MAX_QUEUED_FRAMES:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(frame)
            self._changed.notify_all()

    def _frame(self, index: int, due_s: float, bgr: UInt8[np.ndarray, "height width 3"]) -> Frame:
        rgb = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
        return Frame(index=index, time_s=due_s - self._first_at, rgb=rgb, due_s=due_s)


def _open_device(address: str) -> cv2.VideoCapture:
    """The camera, open.

    Raises:
        InputError: If there is none.
        OSError: If it cannot be opened although it is there.
    """
    silence_opencv()
    number = int(address) if address.isdigit() else None
    device = Path(f"/dev/video{number}") if number is not None else Path(address)
    capture = cv2.VideoCapture(address if number is None else number)
    if capture.isOpened():
        return capture
    capture.release()
    if device.exists() and not os.access(device, os.R_OK):
        raise PermissionError(errno.EACCES, "Permission denied", str(device))
    if device.is_char_device():
        raise OSError(errno.EBUSY, "another program may be using it", str(device))
    there = ", ".join(sorted(path.name[5:] for path in Path("/dev").glob("video[0-9]*"))) or "none"
    raise InputError(
        f"There is no camera {address!r} that can be opened; cameras of this machine: {there}. "
        "Expected camera:0, camera:/dev/video2, or a stream's address, as in camera:rtsp://…"
    )

"""Live sources: a camera, and a folder of images that still grows.

A camera is read by a thread of its own; the latest images are kept, older ones dropped. An image in
a folder is taken when it is complete.
"""

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

from capture.image_folder import (
    EXIF_QUARTER_TURNS,
    any_has_cutout_alpha,
    exif_orientation,
    list_images,
    natural_sort_key,
    read_image,
    silence_opencv,
)
from capture.input_error import InputError
from capture.source import Frame, FrameSelection, PacingClock

CAMERA_PREFIX = "camera:"
"""Start of an argument that names a camera instead of a file."""

MAX_QUEUED_FRAMES = 16
"""Most frames that wait, so that one whose pose is late does not cost the next ones."""

MAX_READ_FAILURES = 16
"""Consecutive failures that mean the end: the camera was unplugged, or the stream is over."""


def camera_address(path: Path) -> str | None:
    """The part of an argument behind `camera:`; None if it names no camera."""
    text = str(path)
    if not text.startswith(CAMERA_PREFIX):
        return None
    return re.sub(r"^(\w+):/(?!/)", r"\1://", text.removeprefix(CAMERA_PREFIX))  # paths fold "//"


@final
class CameraDevice:
    """A camera by its number, a device, the address of a stream, or a file that plays like one.

    `dropped` counts images that were dropped for later ones; `started_at` is when the first came.
    """

    has_alpha = False
    quarter_turns = 0
    live = paced = True
    frames_in_file = 0
    frame_count: int | None = None
    duration_s: float | None = None

    def __init__(self, address: str, selection: FrameSelection, pace: PacingClock) -> None:
        """Open it and wait for its first image.

        Args:
            address: The part of the argument behind `camera:`.
            pace: The clock of those who wait for poses or masks of its images; closing ends it.

        Raises:
            InputError: If there is no such camera.
            OSError: If it exists and is in use (EBUSY), or may not be opened (EACCES).
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
        """Seconds of waiting for images, and for what belongs to them, so far."""
        return self._waited_s + self._pace.waited_s

    def frames(self) -> Iterator[Frame]:
        """The images as they come; to be read once."""
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
        """Release the camera."""
        self._pace.stop()
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        if self._reader is not None:
            self._reader.join(timeout=2.0)  # a stuck driver must not hold what was learnt
        if self._reader is None or not self._reader.is_alive():
            self._capture.release()

    def _next(self) -> Frame | None:
        """The oldest image that waits; None at the end."""
        with self._changed:
            began = time.perf_counter()
            while not (self._waiting or self._ended):
                self._changed.wait(0.1)
            self._waited_s += time.perf_counter() - began
            return self._waiting.popleft() if self._waiting and not self._pace.stopped else None

    def _read(self) -> None:
        """Take images as fast as they come; runs on its own thread."""
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
        """Read until the end; return the number of the last image."""
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
    """Open the camera; an OSError if it exists and cannot be opened."""
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


DONE_FILE_NAME = "DONE"
"""Name of the file whose presence means that no more images will come."""

IDLE_TIMEOUT_S = 10.0
"""Time without a new image after which the source ends, seconds."""

POLL_INTERVAL_S = 0.05
"""Shortest time between two looks at the folder, seconds."""

DAMAGED_AFTER_S = 2.0
"""Time after its last change from which an unreadable image counts as damaged, seconds."""

MAX_PENDING = 8
"""Most pending images; of more, this number is taken, evenly spaced and with the newest."""

MAX_PENDING_AT_START = 200
"""Most images that are taken of those that exist when the watch begins, evenly spaced."""

Picture = tuple[UInt8[np.ndarray, "height width 3"], UInt8[np.ndarray, "height width"] | None]


@final
class WatchedImageFolder:
    """A live source: images that another program writes, in natural order.

    `dropped` counts images that were passed over because too many were waiting; `started_at` is
    when the first was written.
    """

    live = paced = True
    frames_in_file = 0
    frame_count: int | None = None
    duration_s: float | None = None

    def __init__(
        self,
        path: Path,
        selection: FrameSelection,
        pace: PacingClock,
        *,
        idle_s: float = IDLE_TIMEOUT_S,
    ) -> None:
        """Wait for the first image.

        Args:
            path: The folder, which may be empty.
            selection: Counted in natural order.
            pace: Its clock; stopping it ends the watch.
            idle_s: The source ends when no new image has come for this time, seconds.

        Raises:
            InputError: If there is no such folder, or no image in it after `idle_s`.
        """
        if not path.is_dir():
            raise InputError(
                f"{path} is no folder; --live watches a folder of pictures that grows."
            )
        self.path = path
        self.selection = selection
        self.warnings: list[str] = []
        self.dropped = 0
        self._pace, self._idle_s = pace, idle_s
        self._there_before: set[Path] = set()
        first, (rgb, _) = self._first()
        self.quarter_turns = EXIF_QUARTER_TURNS.get(exif_orientation(first.read_bytes()), 0)
        there = list_images(path)
        self.started_at = min(map(_modified_at, there), default=time.time())
        self.size_px, self.has_alpha = (rgb.shape[1], rgb.shape[0]), any_has_cutout_alpha(there)

    @property
    def waited_s(self) -> float:
        """Seconds of waiting for images so far."""
        return self._pace.waited_s

    def frames(self) -> Iterator[Frame]:
        """The images as they are completed."""
        last_s = 0.0
        for index, path in self._arriving():
            if self.selection.is_past_end(index):
                return
            if not self.selection.contains(index):
                continue
            picture = self._complete(path)
            if picture is None:
                continue
            written = _modified_at(path)
            last_s = max(last_s, written - self.started_at)
            age_s = 0.0 if path in self._there_before else max(0.0, time.time() - written)
            yield Frame(
                index=index,
                time_s=last_s,
                rgb=picture[0],
                alpha=picture[1],
                due_s=self._now() - age_s,
                name=path.stem,
            )

    def count_frames(self) -> int:
        """The number of images by now."""
        return len(list_images(self.path))

    def close(self) -> None:
        """End the watch, also in the middle of a wait."""
        self._pace.stop()

    def _first(self) -> tuple[Path, Picture]:
        """The first image that can be read."""
        deadline = self._now() + self._idle_s
        while True:
            for path in list_images(self.path):
                try:
                    return path, read_image(path)
                except (InputError, OSError):
                    continue
            if self._now() >= deadline:
                raise InputError(
                    f"No picture came into {self.path} within {self._idle_s:.0f} s (--idle-seconds)"
                    "; expected PNG, JPEG or the like, written one after the other."
                )
            self._pace.wait_until(self._now() + POLL_INTERVAL_S)

    def _arriving(self) -> Iterator[tuple[int, Path]]:
        """Place in natural order and path of each image that is to be taken."""
        count, newest, quiet_since = 0, None, self._now()
        while not self._pace.stopped:
            looked_at = self._now()
            try:
                done = self._is_done()  # before looking: what came until then is taken
                images = list_images(self.path)
            except OSError as error:
                self._warn(f"{self.path} can no longer be read ({error.strerror}).")
                return
            if newest is None:
                new, most, self._there_before = images, MAX_PENDING_AT_START, set(images)
            else:
                new, most = [p for p in images if natural_sort_key(p) > newest], MAX_PENDING
            if new:
                chosen = np.linspace(0, len(new) - 1, min(most, len(new))).round().astype(int)
                self.dropped += len(new) - len(chosen)
                yield from ((count + int(i), new[i]) for i in chosen)
                count, newest, quiet_since = (
                    count + len(new),
                    natural_sort_key(new[-1]),
                    self._now(),
                )
                continue
            if done or self._now() - quiet_since >= self._idle_s:
                return
            # long folders are looked at less often
            self._pace.wait_until(
                self._now() + max(POLL_INTERVAL_S, 4.0 * (self._now() - looked_at))
            )

    def _now(self) -> float:
        return self._pace.now()

    def _complete(self, path: Path) -> Picture | None:
        """An image once it is whole; None if it never is."""
        while not self._pace.stopped:
            try:
                picture = read_image(path)
            except (InputError, OSError) as cause:
                if time.time() - _modified_at(path) > DAMAGED_AFTER_S:
                    self._warn(f"{cause} It was left out.")
                    return None
                self._pace.wait_until(self._now() + POLL_INTERVAL_S)
                continue
            if picture[0].shape[1::-1] == self.size_px:
                return picture
            self._warn(f"{path.name} is not of the first picture's size. It was left out.")
            return None
        return None

    def _is_done(self) -> bool:
        places = [self.path, self.path.parent] if self.path.name == "images" else [self.path]
        return any((place / DONE_FILE_NAME).exists() for place in places)

    def _warn(self, message: str) -> None:
        if message not in self.warnings and len(self.warnings) < 100:
            self.warnings.append(message)


def _modified_at(path: Path) -> float:
    """Time of the last change of a file, seconds since 1970; long ago if it is gone."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0

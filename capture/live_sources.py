"""Live sources: a camera, and a folder of images that still grows.

A camera is read by a thread of its own; the latest images are kept, older ones dropped. An image in
a folder is taken when it is complete, and waits until then.
"""

import errno
import os
import re
import time
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple, final

import cv2
import numpy as np
from jaxtyping import UInt8

from capture.image_folder import any_has_cutout_alpha, list_images, read_image
from capture.inbox import Inbox
from capture.input_error import InputError
from capture.source import ASSUMED_FPS, Frame, FrameSelection, FrameSource, PacingClock, RgbImage

CAMERA_PREFIX = "camera:"
"""Start of an argument that names a camera instead of a file."""


@cache
def silence_opencv() -> None:
    """Silence OpenCV and its FFmpeg; to be called before a file is opened.

    Our messages explain what is wrong with a file.
    """
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read when FFmpeg is first used
    set_level = getattr(cv2, "setLogLevel", None)  # OpenCV 4 has it here, OpenCV 5 there
    (set_level or cv2.utils.logging.setLogLevel)(0)


def camera_address(path: Path) -> str | None:
    """The part of an argument behind `camera:`; None if it names no camera."""
    text = str(path)
    if not text.startswith(CAMERA_PREFIX):
        return None
    return re.sub(r"^(\w+):/(?!/)", r"\1://", text.removeprefix(CAMERA_PREFIX))  # paths fold "//"


@final
class CameraDevice(FrameSource):
    """A camera by its number, a device, the address of a stream, or a file that plays like one."""

    live = paced = skippable = True

    def __init__(self, address: str, selection: FrameSelection, pace: PacingClock) -> None:
        """Open it by the part of the argument behind `camera:`, and wait for its first image.

        An OSError if it exists and is in use (EBUSY), or may not be opened (EACCES).
        """
        super().__init__(Path(CAMERA_PREFIX + address), selection, pace)
        self._inbox: Inbox[Frame] | None = None
        self._is_file = Path(address).is_file()
        self._capture = _open_device(address)
        ok, picture = self._capture.read()
        if not ok:
            self._capture.release()
            raise OSError(errno.EBUSY, "it is open but gives no picture", str(self.path))
        self.size_px = (int(picture.shape[1]), int(picture.shape[0]))
        self.started_at = time.time()
        self._first_at = time.perf_counter()
        self._first = self._frame(0, self._first_at, picture)

    @property
    def dropped(self) -> int:
        """Number of images that were dropped for later ones."""
        return 0 if self._inbox is None else self._inbox.dropped

    def frames(self) -> Iterator[Frame]:
        """The images as they come; to be read once."""
        # as many may wait: one whose pose is late does not cost the next ones
        self._inbox = inbox = Inbox(self._read(), capacity=16, live=True)
        while not (inbox.finished or self._pace.stopped):
            began = time.perf_counter()
            taken = inbox.take(timeout_s=0.1, max_items=1)
            self._pace.waited_s += time.perf_counter() - began
            for frame in taken:
                if self.selection.is_past_end(frame.index):
                    return
                if self.selection.contains(frame.index):
                    yield frame

    def close(self) -> None:
        """Release the camera."""
        super().close()
        if self._inbox is not None:
            self._inbox.close(timeout_s=2.0)  # a stuck driver must not hold what was learnt
        if self._inbox is None or self._inbox.finished:
            self._capture.release()

    def _read(self) -> Iterator[Frame]:
        """Take images as fast as they come; runs on the inbox's thread."""
        yield self._first
        index, failures = 0, 0
        while failures < 16 and not self._pace.stopped:  # else unplugged, or the stream is over
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
                yield self._frame(index, now, picture)
        if not (self._pace.stopped or self._is_file):
            self._warn(
                f"{self.path} gave no more pictures after {index + 1}; was it unplugged? What was "
                "learnt until then is kept."
            )

    def _frame(self, index: int, due_s: float, bgr: RgbImage) -> Frame:
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


class _FileState(NamedTuple):
    """Size and time stamp of a file, which change while it is written."""

    size: int
    written_s: float


@final
class WatchedImageFolder(FrameSource):
    """A source that grows: images that another program writes.

    Files wait until they are taken, so none is lost. They come in the order in which they are first
    seen, those that are seen together in natural order. Their time stamps, which `mv`, `cp -p` and
    `rsync -a` keep, tell at most how much time lies between two of them.
    """

    paced = True

    def __init__(
        self,
        path: Path,
        selection: FrameSelection,
        pace: PacingClock,
        *,
        idle_s: float = IDLE_TIMEOUT_S,
        watch_s: float | None = None,
    ) -> None:
        """Wait for the first image; an InputError if none has come after `idle_s` seconds.

        The selection is counted in the order of arrival. The source ends when no new image has come
        for `idle_s`; images that come later than `watch_s` after the first are not waited for.
        """
        if not path.is_dir():
            raise InputError(f"{path} is no folder; --live watches a folder of images that grows.")
        super().__init__(path, selection, pace)
        self._idle_s, self._watch_s = idle_s, watch_s
        rgb = self._first()
        self.started_at, self._first_at = time.time(), pace.now()
        self.size_px = (rgb.shape[1], rgb.shape[0])
        self.has_alpha = any_has_cutout_alpha(list_images(path))

    def frames(self) -> Iterator[Frame]:
        """The images as they are completed."""
        time_s, written_s = 0.0, None
        for index, (path, seen_s) in enumerate(self._arriving()):
            if self.selection.is_past_end(index):
                return
            image, state = self._complete(path), _state_of(path)
            if state is not None:  # those that came together were filmed one after the other
                apart_s = 0.0 if written_s is None else state.written_s - written_s
                step_s = min(max(apart_s, 1.0 / ASSUMED_FPS), 1.0) if index else 0.0
                time_s, written_s = max(time_s + step_s, seen_s), state.written_s
            if self.selection.contains(index) and image is not None:
                rgb, alpha = image
                yield Frame(index=index, time_s=time_s, rgb=rgb, alpha=alpha)

    def count_frames(self) -> int:
        """The number of images by now."""
        return len(list_images(self.path))

    def _first(self) -> RgbImage:
        """The first image that can be read."""
        deadline = self._pace.now() + self._idle_s
        while True:
            for path in list_images(self.path):
                with suppress(InputError):
                    return read_image(path)[0]
            if self._pace.now() >= deadline:
                raise InputError(
                    f"No image came into {self.path} within {self._idle_s:g} s (--idle-seconds)"
                    "; expected PNG, JPEG or the like, written one after the other."
                )
            self._pace.wait_until(self._pace.now() + POLL_INTERVAL_S)

    def _arriving(self) -> Iterator[tuple[Path, float]]:
        """Each image once, and when it was first seen, seconds after the first one."""
        known, quiet_since = set[Path](), self._pace.now()
        while not self._pace.stopped:
            looked_at = self._pace.now()
            seen_s = looked_at - self._first_at
            try:
                done = self._is_done()  # before looking: what came until then is taken
                arrived = [path for path in list_images(self.path) if path not in known]
            except OSError as error:
                self._warn(f"{self.path} can no longer be read ({error.strerror}).")
                return
            yield from ((path, seen_s) for path in arrived)
            known.update(arrived)
            quiet_since = looked_at if arrived else quiet_since
            is_over = self._watch_s is not None and seen_s >= self._watch_s
            if is_over or (not arrived and (done or looked_at - quiet_since >= self._idle_s)):
                return
            if not arrived:  # long folders are looked at less often
                now = self._pace.now()
                self._pace.wait_until(now + max(POLL_INTERVAL_S, 4.0 * (now - looked_at)))

    def _complete(
        self, path: Path
    ) -> tuple[RgbImage, UInt8[np.ndarray, "height width"] | None] | None:
        """An image once it is whole, and its alpha channel; None if it never is."""
        state, since = None, self._pace.now()
        while not self._pace.stopped:
            try:
                image = read_image(path)
            except InputError as cause:
                before, state = state, _state_of(path)
                since = since if state == before else self._pace.now()
                if state is None or self._pace.now() - since >= 2.0:  # seconds without a change
                    self._warn(f"{cause} It was left out.")
                    return None
                self._pace.wait_until(self._pace.now() + POLL_INTERVAL_S)
                continue
            return image if self._is_of_size(path.name, image[0]) else None
        return None

    def _is_done(self) -> bool:
        places = [self.path, self.path.parent] if self.path.name == "images" else [self.path]
        return any((place / DONE_FILE_NAME).exists() for place in places)


def _state_of(path: Path) -> _FileState | None:
    """The state of a file; None if it is gone."""
    try:
        stat = path.stat()
    except OSError:
        return None
    return _FileState(stat.st_size, stat.st_mtime)

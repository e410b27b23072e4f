"""Cameras: a video file stands in for one, opened through the same class."""

import errno
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture import live_sources
from capture.input_error import InputError
from capture.live_sources import CameraDevice, camera_address
from capture.source import FrameSelection, PacingClock


class Quick:
    """A camera that gives all its pictures at once, and is then unplugged."""

    def __init__(self, pictures):
        self.left, self.number = pictures, -1
        self.released = False

    def isOpened(self):  # noqa: N802 - OpenCV's name
        return True

    def grab(self):
        self.number += 1
        return self.number < self.left

    def retrieve(self):
        return True, np.full((4, 6, 3), self.number % 256, np.uint8)

    def read(self):
        return self.grab(), self.retrieve()[1]

    def release(self):
        self.released = True


def grey(frame):
    return int(frame.rgb[0, 0, 0])


@pytest.mark.parametrize(
    ("argument", "address"),
    [("camera:0", "0"), ("camera:/dev/video2", "/dev/video2"), ("video.mp4", None),
     ("camera:rtsp://host:554/a", "rtsp://host:554/a"), ("cameras/walk.mp4", None)],
)  # fmt: skip
def test_an_argument_names_a_camera_or_does_not(argument, address):
    assert camera_address(Path(argument)) == address


def test_a_file_comes_like_a_camera_at_its_own_pace(write_video):
    """Ten pictures at 25 a second: 0.36 s; the reader keeps up, so none is lost."""
    source = CameraDevice(str(write_video(frames=10)), FrameSelection(), PacingClock())
    began = time.perf_counter()
    frames = list(source.frames())
    took = time.perf_counter() - began
    source.close()
    assert source.live
    assert source.size_px == (64, 48)
    assert [frame.index for frame in frames] == list(range(10))
    greys = [round((float(f.rgb[:, :28].mean()) - 20) / 11) for f in frames]
    assert greys == list(range(10))
    assert frames[0].rgb[10, 50, 0] > 150 > 80 > frames[0].rgb[10, 50, 2]  # red, not blue
    assert took > 0.3
    times = np.array([frame.time_s for frame in frames])
    assert (times >= np.arange(10) / 25 - 1e-3).all()
    due = np.array([frame.due_s for frame in frames])
    np.testing.assert_allclose(due - due[0], times)
    assert source.dropped == 0
    assert source.waited_s > 0.2


def test_a_late_reader_gets_the_newest_frames_and_a_drop_count(monkeypatch):
    monkeypatch.setattr(live_sources, "_open_device", lambda address: Quick(500))
    source = CameraDevice("0", FrameSelection(), PacingClock())
    frames = source.frames()
    first = next(frames)
    source._inbox._thread.join(timeout=10.0)
    rest = list(frames)
    assert grey(first) == first.index % 256
    oldest = max(first.index + 1, 500 - 16)  # the reader may be through by then
    assert [frame.index for frame in rest] == list(range(oldest, 500))
    assert [grey(frame) for frame in rest] == [frame.index % 256 for frame in rest]
    assert len(rest) + 1 + source.dropped == 500
    source.close()


def test_an_unplugged_camera_ends_the_stream_and_says_so(monkeypatch):
    monkeypatch.setattr(live_sources, "_open_device", lambda address: Quick(5))
    source = CameraDevice("0", FrameSelection(), PacingClock())
    assert [frame.index for frame in source.frames()] == [0, 1, 2, 3, 4]
    (warning,) = source.warnings
    assert "camera:0" in warning
    assert "unplugged" in warning


def test_a_selection_ends_a_camera_too(monkeypatch):
    monkeypatch.setattr(live_sources, "_open_device", lambda address: Quick(12))
    source = CameraDevice("0", FrameSelection(start=2, stop=9, step=3), PacingClock())
    assert [frame.index for frame in source.frames()] == [2, 5, 8]
    source.close()


def test_closing_wakes_who_waits_and_lets_the_camera_go(monkeypatch):
    class Slow(Quick):
        def grab(self):
            if self.number >= 0:
                time.sleep(0.3)
            return super().grab()

    device, pace = Slow(1000), PacingClock()
    monkeypatch.setattr(live_sources, "_open_device", lambda address: device)
    source = CameraDevice("0", FrameSelection(), pace)
    frames = source.frames()
    next(frames)
    began = time.perf_counter()
    source.close()
    assert list(frames) == []
    assert time.perf_counter() - began < 2.0
    assert device.released
    assert pace.stopped


def test_a_camera_that_is_not_there_is_refused_with_those_that_are(capfd):
    with pytest.raises(InputError, match=r"There is no camera '97'.*cameras of this machine"):
        CameraDevice("97", FrameSelection(), PacingClock())
    assert capfd.readouterr().err == ""


def test_a_camera_that_gives_no_picture_is_busy(monkeypatch):
    device = Quick(0)
    monkeypatch.setattr(live_sources, "_open_device", lambda address: device)
    with pytest.raises(OSError, match="no picture") as caught:
        CameraDevice("0", FrameSelection(), PacingClock())
    assert caught.value.errno == errno.EBUSY
    assert device.released


def test_a_device_that_is_there_and_cannot_be_opened_is_busy(monkeypatch):
    class Closed:
        def isOpened(self):  # noqa: N802 - OpenCV's name
            return False

        def release(self):
            pass

    monkeypatch.setattr(cv2, "VideoCapture", lambda address: Closed())
    monkeypatch.setattr(Path, "exists", lambda path: True)
    monkeypatch.setattr(Path, "is_char_device", lambda path: True)
    monkeypatch.setattr(live_sources.os, "access", lambda path, mode: True)
    with pytest.raises(OSError, match="another program") as caught:
        CameraDevice("0", FrameSelection(), PacingClock())
    assert caught.value.errno == errno.EBUSY
    monkeypatch.setattr(live_sources.os, "access", lambda path, mode: False)
    with pytest.raises(PermissionError):
        CameraDevice("0", FrameSelection(), PacingClock())

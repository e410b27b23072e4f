"""Folders that another program writes to while they are read; the clock is the test's."""

import os
import shutil
import threading

import cv2
import numpy as np
import pytest

from capture.input_error import InputError
from capture.live_sources import WatchedImageFolder
from capture.source import FrameSelection, PacingClock
from preprocess.tracked_stream import TrackedStream


class Writer:
    """Writes images into a folder while the clock, which stands still otherwise, is waited on."""

    def __init__(self, folder) -> None:
        self.folder, self.now_s, self.pace = (
            folder,
            0.0,
            PacingClock(clock=self.clock, wait=self.wait),
        )
        self._plan, self._lock = [], threading.Lock()

    def clock(self):
        return self.now_s

    def wait(self, seconds):
        """Pass time; what is due meanwhile is done, whichever thread waits."""
        with self._lock:
            self.now_s += seconds
            while self._plan and self._plan[0][0] <= self.now_s:
                self._plan.pop(0)[1]()

    def at(self, seconds, work):
        self._plan.append((seconds, work))

    def write(self, index, content=None, written_s=None):
        data = cv2.imencode(".png", np.full((6, 8, 3), index, np.uint8))[1].tobytes()
        path = self.folder / f"shot_{index}.png"
        path.write_bytes(data if content is None else content(data))
        if written_s is not None:
            os.utime(path, (written_s, written_s))

    def watch(self, *, idle_s=3.0, selection=None, watch_s=None):
        selection = selection or FrameSelection()
        return WatchedImageFolder(self.folder, selection, self.pace, idle_s=idle_s, watch_s=watch_s)


@pytest.fixture
def writer(tmp_path):
    return Writer(tmp_path)


def greys(frames):
    return [int(frame.rgb[0, 0, 0]) for frame in frames]


def cut_off(data):
    return data[:30]


def test_images_come_as_they_are_written_and_in_natural_order(writer):
    writer.write(0)
    for index in range(1, 14):
        writer.at(0.2 * index, lambda index=index: writer.write(index))
    writer.at(3.0, (writer.folder / "DONE").touch)
    source = writer.watch(idle_s=20.0)
    frames = list(source.frames())
    assert writer.now_s < 10.0  # DONE ended it, not the wait for another image
    assert greys(frames) == [frame.index for frame in frames] == list(range(14))
    times = [frame.time_s for frame in frames]
    assert times == sorted(set(times))
    assert source.paced
    assert source.waited_s > 2.0


@pytest.mark.parametrize("stamps", ["as written", "kept by mv", "all the same", "descending"])
def test_none_of_65_images_is_lost_however_late_its_turn_and_whatever_its_time_stamp(
    writer, stamps
):
    """They come at 2.5 a second, and tracking takes twice as long as that for each."""
    kept = {
        "as written": lambda index: None,
        "kept by mv": lambda index: 1e9 + 0.04 * index,
        "all the same": lambda index: 1e9,
        "descending": lambda index: 1e9 - index,
    }[stamps]
    for index in range(65):
        writer.at(0.4 * index, lambda index=index: writer.write(index, written_s=kept(index)))
    stream, taken = TrackedStream(writer.watch(idle_s=6.0)), []
    for frame in stream.frames():
        taken.append(frame)
        writer.wait(0.8)
    assert greys(taken) == [frame.index for frame in taken] == list(range(65))
    assert stream.dropped == 0
    assert not stream.warnings
    assert (np.diff([frame.time_s for frame in taken]) > 0.03).all()


def test_images_that_came_together_are_as_far_apart_as_they_were_filmed(writer):
    for index in range(5):
        writer.write(index, written_s=1e9 + 0.25 * index)
    times = [frame.time_s for frame in writer.watch().frames()]
    assert np.allclose(times, 0.25 * np.arange(5))


def test_an_image_whose_name_comes_before_earlier_ones_is_taken_when_it_comes(writer):
    writer.write(5)
    writer.at(1.0, lambda: writer.write(3))
    writer.at(2.0, lambda: writer.write(9))
    frames = list(writer.watch().frames())
    assert greys(frames) == [5, 3, 9]
    assert [frame.index for frame in frames] == [0, 1, 2]


def test_it_ends_when_nothing_new_comes_although_images_still_wait(writer):
    for index in range(8):
        writer.write(index)
    taken = []
    for frame in writer.watch(idle_s=2.0).frames():
        taken.append(frame)
        writer.wait(1.0)
    assert greys(taken) == list(range(8))
    assert writer.now_s < 8.5


def test_what_comes_after_the_time_is_not_waited_for(writer):
    for index in range(20):
        writer.at(float(index), lambda index=index: writer.write(index))
    frames = greys(writer.watch(watch_s=5.5).frames())
    assert frames == list(range(len(frames)))
    assert 5 <= len(frames) <= 7


def test_the_first_image_is_waited_for(writer):
    writer.at(1.5, lambda: writer.write(3))
    source = writer.watch(idle_s=10.0)
    assert source.size_px == (8, 6)
    assert not source.has_alpha


def test_a_folder_that_stays_empty_is_refused(writer, tmp_path):
    with pytest.raises(InputError, match="No image came into"):
        writer.watch(idle_s=0.1)
    with pytest.raises(InputError, match="no folder"):
        Writer(tmp_path / "none").watch()


def test_a_half_written_image_is_waited_for_although_its_time_stamp_is_old(writer):
    writer.write(0)
    writer.write(1, content=cut_off, written_s=1e9)

    def finish():
        writer.write(1, written_s=1e9)
        writer.write(2)

    writer.at(1.5, finish)
    source = writer.watch()
    assert greys(source.frames()) == [0, 1, 2]
    assert not source.warnings


def test_an_image_that_stays_damaged_is_left_out_and_named(writer):
    for index in range(3):
        writer.write(index, content=cut_off if index == 1 else None)
    source = writer.watch()
    assert [frame.index for frame in source.frames()] == [0, 2]
    assert "shot_1.png" in source.warnings[0]


def test_a_folder_that_is_unplugged_ends_the_stream(writer):
    for index in range(3):
        writer.write(index)
    source = writer.watch(idle_s=30.0)
    frames = source.frames()
    assert next(frames).index == 0
    shutil.rmtree(writer.folder)
    assert [frame.index for frame in frames] == []
    assert any("no longer be read" in warning for warning in source.warnings)


def test_closing_ends_the_watch_at_once(writer):
    writer.write(0)
    source = writer.watch(idle_s=3600.0)
    writer.at(1.0, source.close)
    assert greys(source.frames()) == [0]
    assert writer.now_s < 2.0


def test_a_selection_counts_images_in_the_order_of_arrival(writer):
    for index in range(12):
        writer.write(index)
    source = writer.watch(selection=FrameSelection(start=1, stop=9, step=3))
    assert greys(source.frames()) == [1, 4, 7]
    assert source.count_frames() == 12

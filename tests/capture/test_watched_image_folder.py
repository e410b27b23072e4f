"""Folders that another program writes to while they are read."""

import shutil
import threading
import time

import cv2
import numpy as np
import pytest

from capture import live_sources
from capture.input_error import InputError
from capture.live_sources import WatchedImageFolder
from capture.source import FrameSelection, PacingClock


def picture(index):
    return np.full((6, 8, 3), index, np.uint8)


def write(folder, index, content=None):
    data = cv2.imencode(".png", picture(index))[1].tobytes()
    (folder / f"shot_{index}.png").write_bytes(data if content is None else content(data))


def watch(folder, *, idle_s=0.3, selection=None):
    return WatchedImageFolder(folder, selection or FrameSelection(), PacingClock(), idle_s=idle_s)


def greys(frames):
    return [int(frame.rgb[0, 0, 0]) for frame in frames]


def in_the_background(work):
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    return thread


def test_pictures_come_as_they_are_written_and_in_natural_order(tmp_path):
    write(tmp_path, 0)

    def writer():
        for index in range(1, 14):
            time.sleep(0.02)
            write(tmp_path, index)
        (tmp_path / "DONE").touch()

    source = watch(tmp_path, idle_s=20.0)
    thread, began = in_the_background(writer), time.monotonic()
    frames = list(source.frames())
    thread.join()
    assert time.monotonic() - began < 10.0  # DONE ended it, not the wait for another picture
    assert greys(frames) == [frame.index for frame in frames] == list(range(14))
    assert [frame.name for frame in frames] == [f"shot_{i}" for i in range(14)]
    times = [frame.time_s for frame in frames]
    assert times == sorted(times)
    assert source.dropped == 0
    assert source.live
    assert source.paced
    assert source.waited_s > 0.1


def test_it_ends_when_nothing_new_comes(tmp_path):
    write(tmp_path, 0)
    source, began = watch(tmp_path, idle_s=0.2), time.monotonic()
    assert greys(source.frames()) == [0]
    assert 0.2 <= time.monotonic() - began < 5.0


def test_the_first_picture_is_waited_for(tmp_path):
    def writer():
        time.sleep(0.15)
        write(tmp_path, 3)

    thread = in_the_background(writer)
    source = watch(tmp_path, idle_s=10.0)
    thread.join()
    assert source.size_px == (8, 6)
    assert not source.has_alpha


def test_a_folder_that_stays_empty_is_refused(tmp_path):
    with pytest.raises(InputError, match="No picture came into"):
        watch(tmp_path, idle_s=0.1)
    with pytest.raises(InputError, match="no folder"):
        watch(tmp_path / "none")


def test_a_half_written_picture_is_waited_for(tmp_path):
    write(tmp_path, 0)
    write(tmp_path, 1, content=lambda data: data[:30])

    def finishes():
        time.sleep(0.15)
        write(tmp_path, 1)
        write(tmp_path, 2)

    thread = in_the_background(finishes)
    source = watch(tmp_path)
    assert greys(source.frames()) == [0, 1, 2]
    thread.join()
    assert not source.warnings


def test_a_picture_that_stays_damaged_is_left_out_and_told(tmp_path, monkeypatch):
    monkeypatch.setattr(live_sources, "DAMAGED_AFTER_S", 0.1)
    for index in range(3):
        write(tmp_path, index, content=(lambda data: data[:30]) if index == 1 else None)
    source = watch(tmp_path, idle_s=0.1)
    frames = list(source.frames())
    assert [frame.index for frame in frames] == [0, 2]
    assert "shot_1.png" in source.warnings[0]


def test_who_comes_late_gets_an_even_choice_with_the_newest(tmp_path):
    """He is up to date again afterwards, and has seen something of everything."""
    write(tmp_path, 0)
    source = watch(tmp_path)
    frames = source.frames()
    assert next(frames).index == 0
    for index in range(1, 51):
        write(tmp_path, index)
    rest = [frame.index for frame in frames]
    assert len(rest) == live_sources.MAX_PENDING
    assert (rest[0], rest[-1]) == (1, 50)
    assert set(np.diff(rest)) == {7}
    assert source.dropped == 50 - live_sources.MAX_PENDING


def test_what_was_there_before_is_not_lost(tmp_path):
    for index in range(60):
        write(tmp_path, index)
    source = watch(tmp_path, idle_s=0.1)
    frames = list(source.frames())
    assert greys(frames) == list(range(60))
    assert source.dropped == 0
    # pictures that are older than the watch are not late
    assert all(frame.due_s <= time.perf_counter() for frame in frames)
    assert frames[0].due_s > time.perf_counter() - 60.0


def test_a_folder_that_is_unplugged_ends_the_stream(tmp_path):
    folder = tmp_path / "stick"
    folder.mkdir()
    for index in range(3):
        write(folder, index)
    source = watch(folder, idle_s=30.0)
    frames = source.frames()
    assert next(frames).index == 0
    shutil.rmtree(folder)
    growing_again = [frame.index for frame in frames]
    assert growing_again == []
    assert any("no longer be read" in warning for warning in source.warnings)


def test_closing_ends_the_watch_at_once(tmp_path):
    write(tmp_path, 0)
    source, taken = watch(tmp_path, idle_s=3600.0), []
    thread = in_the_background(lambda: taken.extend(source.frames()))
    while not taken:
        time.sleep(0.002)
    source.close()
    thread.join(timeout=5.0)
    assert not thread.is_alive()


def test_a_selection_counts_pictures_in_natural_order(tmp_path):
    for index in range(12):
        write(tmp_path, index)
    source = watch(tmp_path, selection=FrameSelection(start=1, stop=9, step=3))
    assert greys(source.frames()) == [1, 4, 7]
    assert source.count_frames() == 12

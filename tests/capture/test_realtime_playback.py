"""Recordings played as live captures: when frames come, and that none is lost."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from capture.source import Frame, FrameSelection, FrameSource, PacingClock, RealtimePlayback
from capture.source_opening import open_source

UNEVEN_S = [5.0, 5.04, 5.1, 5.1, 5.7, 5.733]
"""Timestamps of no fixed rate; one comes twice, and the first is not 0."""


class Time:
    """A clock that only stands still or jumps."""

    def __init__(self):
        self.now_s = 100.0
        self.waits = []

    def __call__(self):
        return self.now_s

    def wait(self, seconds):
        self.waits.append(seconds)
        self.now_s += seconds


class Recorded(FrameSource):
    """A source of tiny frames at given times."""

    size_px = (2, 2)
    frames_in_file = frame_count = len(UNEVEN_S)
    duration_s = 0.77

    def __init__(self, times=UNEVEN_S):
        super().__init__(Path("uneven.mp4"), FrameSelection())
        self.times, self.warnings, self.closed = times, ["a gap"], False

    def frames(self):
        for index, time_s in enumerate(self.times):
            yield Frame(index=index, time_s=time_s, rgb=np.full((2, 2, 3), index, np.uint8))

    def count_frames(self):
        return len(self.times)

    def close(self):
        self.closed = True


@pytest.fixture
def clock():
    return Time()


def played(source, clock):
    return RealtimePlayback(source, PacingClock(clock=clock, wait=clock.wait))


def test_each_frame_comes_at_its_own_time_which_it_says_and_the_first_at_once(clock):
    frames, moments = zip(*((f, clock()) for f in played(Recorded(), clock).frames()), strict=True)
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4, 5]
    assert [frame.time_s for frame in frames] == UNEVEN_S
    np.testing.assert_allclose(moments, 100.0 + np.array(UNEVEN_S) - 5.0, atol=1e-9)
    np.testing.assert_allclose([frame.due_s for frame in frames], moments)


def test_who_takes_frames_late_loses_none_and_catches_up_and_waiting_alone_is_counted(clock):
    playback, lateness = played(Recorded(), clock), []
    for frame in playback.frames():
        lateness.append(clock() - frame.due_s)
        clock.now_s += 0.1 if frame.index < 3 else 0.0
    np.testing.assert_allclose(lateness, [0.0, 0.06, 0.1, 0.2, 0.0, 0.0], atol=1e-9)
    assert playback.waited_s == pytest.approx(clock.now_s - 100.0 - 0.3)


def test_a_timestamp_that_runs_backwards_is_played_at_once(clock):
    came = [clock() for _ in played(Recorded([0.0, 1.0, 0.2, 1.5]), clock).frames()]
    np.testing.assert_allclose(np.array(came) - 100.0, [0.0, 1.0, 1.0, 1.5])


def test_what_was_seen_before_comes_at_once_and_the_rest_at_its_own_time_from_there(clock):
    playback, came = played(Recorded([0.0, 1.0, 2.0, 3.0, 4.5]), clock), []
    playback.catch_up = True
    for frame in playback.frames():
        came.append(clock() - 100.0)
        assert frame.due_s == clock()
        playback.catch_up = frame.index < 2
    np.testing.assert_allclose(came, [0.0, 0.0, 0.0, 1.0, 2.5])


def test_what_is_known_of_the_recording_is_known_of_its_playback(clock):
    source = Recorded()
    playback = played(source, clock)
    assert playback.paced
    assert not playback.live
    for name in ("path", "size_px", "frame_count", "duration_s", "warnings", "has_alpha"):
        assert getattr(playback, name) == getattr(source, name)
    assert playback.count_frames() == 6
    playback.close()
    assert source.closed


def test_closing_ends_a_wait_at_once():
    playback = RealtimePlayback(Recorded([0.0, 3600.0]), PacingClock())
    taken = []
    thread = threading.Thread(target=lambda: taken.extend(playback.frames()))
    thread.start()
    while not taken:
        time.sleep(0.002)
    began = time.monotonic()
    playback.close()
    thread.join(timeout=5.0)
    assert not thread.is_alive()
    assert time.monotonic() - began < 1.0
    assert [frame.index for frame in taken] == [0]


@pytest.mark.parametrize(
    ("chosen", "seconds"), [(None, 0.8), (slice(5, None), 0.6), (slice(0, 10, 3), 0.4)]
)
def test_the_clip_lasts_as_long_as_its_wanted_frames(write_video, write_images, chosen, seconds):
    video = open_source(write_video(frames=20), frames=chosen)
    assert video.duration_s == pytest.approx(seconds)
    images = open_source(write_images(20), frames=chosen)
    assert images.duration_s == pytest.approx(seconds * 25.0 / 30.0)

"""What is counted while a stream goes by."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from capture.source import Frame, FrameSelection, FrameSource
from instant_avatar.run.stream_meter import MAX_DROPPED_LISTED, StreamMeter
from preprocess.observation import DroppedFrame


class Recorded(FrameSource):
    """A source of which only the counts matter."""

    size_px, waited_s = (2, 2), 0.0

    def __init__(self):
        super().__init__(Path("video.mp4"), FrameSelection())


def frames(times, due=None):
    for index, time_s in enumerate(times):
        yield Frame(
            index=index, time_s=time_s, rgb=np.zeros((2, 2, 3), np.uint8),
            due_s=None if due is None else due[index],
        )  # fmt: skip


def test_a_meter_times_what_passes_without_the_waiting_and_stops_when_asked():
    stop, source = threading.Event(), Recorded()
    meter = StreamMeter(stop, source)

    def slow():
        for number in range(5):
            time.sleep(0.05)
            source.waited_s += 0.03
            yield number

    taken = []
    for number in meter.measure_preparation(slow()):
        taken.append(number)
        if number == 2:
            stop.set()
    assert taken == [0, 1, 2]
    prepared = meter.stats(ready_at=None).ingest_ms
    assert 20.0 <= prepared.p50 <= prepared.p95
    assert min(meter.preparation_s) == pytest.approx(0.02, abs=0.015)


def test_latency_runs_from_the_moment_a_frame_was_due_until_the_trainer_has_it():
    meter, now = StreamMeter(threading.Event(), Recorded()), time.perf_counter()
    due = [now - 3.0, now - 2.0, now - 1.0]
    assert len(list(meter.measure_arrival(frames([0.0, 1.0, 2.0], due)))) == 3
    for index in range(3):
        meter.mark_arrived(index, held_out=index == 1)
    assert meter.latency_s == pytest.approx([3.0, 2.0, 1.0], abs=0.5)
    assert meter.held_out_count == 1
    assert meter.current_latency_s == pytest.approx(1.0, abs=0.5)
    assert max(meter.lateness_s) == pytest.approx(3.0, abs=0.5)


def test_frames_that_never_arrive_are_forgotten():
    meter = StreamMeter(threading.Event(), Recorded())
    list(meter.measure_arrival(frames(np.arange(100) / 30.0)))
    meter.mark_arrived(98, held_out=False)
    assert len(meter.latency_s) == 1
    assert [index for index, _ in meter._available_at] == [99]


@pytest.mark.parametrize(
    ("times", "due", "ready_at", "seconds"),
    [
        ([7.0, 9.5, 11.0], [100.0, 102.5, 104.0], 105.25, 1.25),
        ([0.0, 1.0, 2.0, 4.0], [100.0, 100.0, 100.0, 102.0], 102.5, 0.5),
        ([0.0, 1.0], [100.0, 101.0], None, None),
    ],
    ids=["played", "resumed after two seconds", "never ready"],
)
def test_ready_counts_from_the_last_frame_as_if_it_had_been_filmed(times, due, ready_at, seconds):
    meter = StreamMeter(threading.Event(), Recorded())
    list(meter.measure_arrival(frames(times, due)))
    assert meter.stats(ready_at=ready_at).ready_after_last_frame_seconds == seconds


def test_ready_may_be_before_the_end_of_a_video_that_is_read_faster_than_it_plays():
    meter = StreamMeter(threading.Event(), Recorded())
    list(meter.measure_arrival(frames([0.0, 60.0])))
    ready = meter.stats(ready_at=time.perf_counter()).ready_after_last_frame_seconds
    assert -60.0 <= ready < -55.0


def test_of_very_many_lost_frames_only_the_number_is_kept():
    meter = StreamMeter(threading.Event(), Recorded())
    lost = (DroppedFrame(index=i, reason="pose invalid") for i in range(MAX_DROPPED_LISTED + 500))
    assert len(list(meter.count_observations(lost))) == MAX_DROPPED_LISTED + 500
    assert meter.dropped_count == MAX_DROPPED_LISTED + 500
    assert [note.index for note in meter.dropped] == list(range(MAX_DROPPED_LISTED))


@pytest.mark.parametrize(
    ("frame_count", "hints"), [(3, 1), (None, 0)], ids=["--realtime", "a phone's film"]
)
def test_only_of_a_played_recording_other_options_are_advised(frame_count, hints):
    source, now = Recorded(), time.perf_counter()
    source.paced, source.frame_count = True, frame_count
    meter = StreamMeter(threading.Event(), source)
    list(meter.measure_arrival(frames([0.0, 1.0, 2.0], [now - 3.0, now - 2.0, now - 1.0])))
    assert sum("--frames ::2" in message for message in meter.lateness_warnings()) == hints

"""A recorded video played as a live capture, from the command line."""

import json
import time

import pytest

from capture.source import PacingClock
from capture.source_opening import open_source
from instant_avatar import ingest
from instant_avatar.run.ingest_arguments import IngestArguments
from preprocess import capture_session


@pytest.fixture
def play(call, on_one_core, without_baking, tmp_path):
    """Runs ia-ingest --realtime; returns its report."""

    def play(capture, *arguments):
        ended = call(ingest, capture, "--realtime", "--out", tmp_path / "run", *arguments)
        assert ended.code == 0, ended.err
        return json.loads((tmp_path / "run" / "report.json").read_text())

    return play


def test_a_played_video_is_learnt_while_it_lasts_and_none_of_it_is_lost(play, film):
    report = play(film, "--frames", ":12", "--no-refine-poses")  # at 30 fps
    stream, training = report["stream"], report["training"]
    assert stream["realtime"]
    assert stream["inbox_dropped"] == 0
    assert report["frames"]["read"] == 12
    assert report["recipe"]["seconds"] == pytest.approx(0.4)
    assert training["wall_seconds"] >= 11 / 30 - stream["latency_ms"]["p95"] / 1000.0
    assert stream["latency_ms"]["p50"] >= stream["lateness_ms"]["p50"] >= 0.0
    assert stream["latency_ms"]["p50"] >= 0.5 * stream["ingest_ms"]["p50"]
    # training was over no earlier than the video, so the package was not either
    assert stream["ready_after_last_frame_seconds"] > 0.0


@pytest.fixture
def waits(monkeypatch):
    """What is waited for frames from now on, seconds; time stands still but in these waits."""
    found, began = [], time.perf_counter()
    pace = PacingClock(clock=lambda: began + sum(found), wait=found.append)
    monkeypatch.setattr(capture_session, "PacingClock", lambda: pace)
    return found


@pytest.mark.slow
def test_what_a_resumed_run_saw_before_is_not_played_again(play, film, request):
    """Of the clip, which lasts 0.4 s; more seconds are used after it."""
    before = play(film, "--frames", ":12", "--seconds", "0.5")
    assert before["recipe"]["seconds"] == 0.5
    assert before["training"]["wall_seconds"] >= 0.5
    waits = request.getfixturevalue("waits")
    report = play(film, "--seconds", "0.9", "--resume")
    assert report["frames"]["read"] == 24
    assert report["frames"]["used"] > before["frames"]["used"]
    # what was learnt before came at once: only the others may have been waited for
    assert len(waits) <= 24 - before["frames"]["used"] < 23


@pytest.mark.parametrize(
    ("words", "seconds"),
    [({}, 60.0), ({"realtime": True}, 0.8), ({"realtime": True, "seconds": 5.0}, 5.0),
     ({"realtime": True, "frames": "6:18:2"}, 11 / 30)],
)  # fmt: skip
def test_without_seconds_a_minute_or_the_clip_is_learnt(film, words, seconds):
    given = IngestArguments(video=film, **words)
    assert given.training_seconds(
        open_source(film, frames=given.capture_inputs().frames)
    ) == pytest.approx(seconds)

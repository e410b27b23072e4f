"""A run as a stream of events: their order, readers, checkpoints, and Ctrl-C."""

import json
import signal
import threading
from collections import Counter
from contextlib import ExitStack
from dataclasses import asdict, replace
from functools import partial
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from avatar.evaluation.coverage import Coverage
from avatar.events import FrameArrived, FrameLeftOut, Stepped
from avatar.training import checkpoint
from avatar.training.frame_stream import separate_held_out
from avatar.training.trainer import Trainer
from export.bake.bake_tables import ExportRefused
from export.build import ExportReport
from instant_avatar import train
from instant_avatar.cli.console import Console
from instant_avatar.report import report_writer
from instant_avatar.run import snapshot_writer
from instant_avatar.run.console_reader import ConsoleReader
from instant_avatar.run.run_folder import RunFolder
from instant_avatar.run.session_events import PackageWritten, Scored, SessionEvent
from instant_avatar.run.session_start import _announce_coverage
from instant_avatar.run.snapshot_writer import CheckpointWriter
from instant_avatar.run.training_session import TrainingSession
from preprocess.capture_inputs import CaptureInputs
from preprocess.capture_session import Capture, RecordedObservations
from preprocess.observation import DroppedFrame
from preprocess.open_capture import open_capture


class EventLog:
    """A face of its own: writes every step and frame as a line of JSON."""

    def __init__(self, path):
        self.path = path

    def __call__(self, event: SessionEvent) -> None:
        match event:
            case Stepped() | FrameArrived() | FrameLeftOut():
                content = asdict(event)
            case PackageWritten(path=path, is_final=is_final):
                content = {"path": path.name, "is_final": is_final}
            case _:
                content = {}
        with self.path.open("a", encoding="utf-8") as log:
            log.write(json.dumps({"event": type(event).__name__, **content}) + "\n")


@pytest.fixture
def learn(capture, call_ingest, without_baking, tmp_path):
    """Learns for a few steps with readers; call_ingest makes that fast."""

    def learn(*readers, **options):
        return train(
            capture, tmp_path / "run", frames="0:12", steps=10, refine_poses=False, quiet=True,
            readers=readers, **options,
        )  # fmt: skip

    return learn


@pytest.fixture
def drawn(monkeypatch):
    """Animations that are drawn of packages."""
    drawn = []
    monkeypatch.setattr(report_writer, "demo_animation", lambda player: drawn.append(0) or b"")
    return drawn


def test_a_reader_of_a_few_lines_learns_all_about_a_run(
    learn, drawn, tmp_path, monkeypatch, capsys
):
    """Package and page are there before scores are made, and the call returns both."""
    monkeypatch.setattr(snapshot_writer, "export_avatar", write_twice)
    page, unscored = tmp_path / "run" / "report.html", []

    def read(event):
        if isinstance(event, PackageWritten):
            assert (tmp_path / "run" / "avatar.iavatar").exists()
        if isinstance(event, Scored):
            unscored.append(page.read_text())

    avatar = learn(EventLog(tmp_path / "events.jsonl"), read)
    assert "ia-play" in unscored[0]
    assert "scores are being made" in unscored[0]
    assert "not learnt from" not in unscored[0]  # no frame is scored yet
    assert "not learnt from" in page.read_text()
    assert avatar.report == json.loads((tmp_path / "run" / "report.json").read_text())
    assert avatar.report["held_out"]["psnr"] is not None
    assert avatar.verdict == avatar.report["verdict"]
    assert capsys.readouterr().err == ""
    events = [json.loads(line) for line in (tmp_path / "events.jsonl").read_text().splitlines()]
    counts = Counter(event["event"] for event in events)
    assert counts["Stepped"] == 10
    assert counts["FrameArrived"] == 12
    names = [event["event"] for event in events]
    ends = ["Finished", "PackageWritten", "PackageWritten", "Scored", "Ended"]
    assert [name for name in names if name in ends] == ends
    packages = [event for event in events if event["event"] == "PackageWritten"]
    assert [(each["path"], each["is_final"]) for each in packages] == [
        ("avatar.iavatar", False), ("avatar.iavatar", True)
    ]  # fmt: skip
    assert avatar.report["package"]["bytes"] == 8  # scores are stored in the finer one
    assert avatar.package.read_bytes() == b"aa"
    assert len(drawn) == 1  # of this avatar fine-tuning does not show


def write_twice(avatar, path, *, progress, psnr_db=(40.0, 45.0), **options):
    """Writes a package, and then one that is fine-tuned, as `export_avatar` does."""
    assert options["baked_first"]
    assert options["fine_tune_bricks"]
    for number in range(2):
        if number:
            try:
                progress(0.5)
            except KeyboardInterrupt:
                return
        path.write_bytes(b"a" * (number + 1))
        yield ExportReport(
            path=path, bytes=number + 1, seconds=0.0,
            psnr_to_renderer={"hq": psnr_db[number]},
            largest_difference=0.0, warnings=(),
        )  # fmt: skip


@pytest.mark.slow
def test_the_package_as_baked_stays_if_the_fine_tuned_one_is_refused(learn, monkeypatch):
    def refuse_the_second(avatar, path, **options):
        yield next(write_twice(avatar, path, **options))
        raise ExportRefused("fog")

    monkeypatch.setattr(snapshot_writer, "export_avatar", refuse_the_second)
    avatar = learn()
    assert avatar.package.read_bytes() == b"a"
    assert avatar.report["package"] is not None


@pytest.mark.slow
def test_the_animation_is_drawn_again_where_fine_tuning_shows(learn, drawn, monkeypatch):
    finer = partial(write_twice, psnr_db=(34.0, 37.0))
    monkeypatch.setattr(snapshot_writer, "export_avatar", finer)
    learn()
    assert len(drawn) == 2


@pytest.mark.parametrize("when", ["first", pytest.param("final", marks=pytest.mark.slow)])
def test_ctrl_c_after_the_package_leaves_out_the_rest_and_keeps_everything(
    learn, tmp_path, monkeypatch, when
):
    monkeypatch.setattr(snapshot_writer, "export_avatar", write_twice)

    def read(event):
        if isinstance(event, PackageWritten) and when == ("final" if event.is_final else "first"):
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        learn(read)
    out = tmp_path / "run"
    report = json.loads((out / "report.json").read_text())
    if when == "first":  # later it may have been scored, beside the fine-tuning
        assert report["verdict"] is None
    sizes = {"first": [1], "final": [2, 8]}[when]  # scores are stored in 8 bytes
    assert report["package"]["bytes"] in sizes
    assert "ia-play" in (out / "report.html").read_text()
    assert (out / "checkpoint" / "frames.tensors").exists()
    assert (out / "checkpoint" / "state.pt").exists()


def test_the_newest_frame_is_shown_and_coverage_counts_those_that_are_learnt(film, tmp_path):
    capture = open_capture(CaptureInputs(video=film))
    session = TrainingSession(
        Trainer.__new__(Trainer),
        RecordedObservations(capture),
        RunFolder(path=tmp_path / "run"),
        threading.Event(),
        {},
    )
    observations = list(capture.observations())
    stream = [*observations[:4], DroppedFrame(index=4, reason="lost"), *observations[5:24]]
    newest = [
        session.newest_observation.frame.index
        for item in session._watch(separate_held_out(iter(stream), stride=10, total=24))
        if not isinstance(item, DroppedFrame)
    ]
    assert newest == [index for index in range(24) if index != 4]
    alone = Coverage(capture.shaped)
    for item in stream:
        if not isinstance(item, DroppedFrame) and item.frame.index not in (9, 19):
            alone.add(item)
    assert np.array_equal(session.coverage.cosines, alone.cosines)


TRAINER = Trainer.__new__(Trainer)
TRAINER.steps = 7


@pytest.fixture
def writer(tmp_path, monkeypatch) -> CheckpointWriter:
    monkeypatch.setattr(checkpoint, "detached_state", lambda trainer, notes: dict(notes))
    monkeypatch.setattr(snapshot_writer, "write_shaped_body", lambda path, shaped: None)
    monkeypatch.setattr(snapshot_writer, "CHECKPOINT_INTERVAL_S", 0.0)
    capture = Capture.__new__(Capture)
    object.__setattr__(capture, "shaped", None)
    return CheckpointWriter(RunFolder(path=tmp_path), capture)


def test_training_goes_on_while_a_checkpoint_is_written(writer, monkeypatch):
    gate, written = threading.Event(), []

    def slow(state, folder):
        assert gate.wait(10.0)
        written.append((state, threading.current_thread()))

    monkeypatch.setattr(checkpoint, "write_state", slow)
    monkeypatch.setattr(snapshot_writer, "CHECKPOINT_COST_SHARE", 1e9)
    assert writer.is_due()
    writer.begin(TRAINER, {"step": 1})
    assert not writer.is_due()  # the first is not yet written
    assert writer.take_saved() == []
    gate.set()
    writer.settle()
    assert writer.is_due()
    assert writer.take_saved() == [7]
    ((kept, thread),) = written
    assert kept == {"step": 1}
    assert thread is not threading.main_thread()


def test_checkpoints_that_cost_much_are_rare(writer, monkeypatch):
    monkeypatch.setattr(checkpoint, "write_state", lambda state, folder: sum(range(100_000)))
    monkeypatch.setattr(snapshot_writer, "CHECKPOINT_COST_SHARE", 1e-9)
    writer.begin(TRAINER, {})
    writer.settle()
    assert not writer.is_due()


@pytest.mark.parametrize("how", ["is_due", "wait"])
def test_a_full_disk_is_reported_to_the_thread_that_trains(writer, monkeypatch, how):
    def full(state, folder):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint, "write_state", full)
    writer.begin(TRAINER, {})
    writer.settle()  # does not raise
    with pytest.raises(OSError, match="No space"):
        getattr(writer, how)()


def announced(capture) -> list[str]:
    console = Console()
    _announce_coverage(capture, console)
    return console.warnings


def test_unseen_skin_is_warned_of_by_frames_that_have_a_pose(film):
    assert not announced(open_capture(CaptureInputs(video=film)))
    front = open_capture(CaptureInputs(video=film, frames=slice(0, 3)))
    (warning,) = announced(front)
    assert "back" in warning
    numbers = np.arange(24.0)
    numbers[5:] = np.nan
    strays = replace(front.geometry(), row_frames=numbers)
    object.__setattr__(front, "geometry", lambda: strays)
    assert announced(front) == [warning]


@pytest.mark.parametrize(
    ("steps", "budget", "shown"),
    [
        (60, {"seconds": 3.0, "steps": 60}, "step 60 of 60, 7 s"),
        (96, {"seconds": 3.0, "steps": 60}, "step 96, 7 s"),
        (96, {"seconds": 68.3112, "steps": None}, "7 of 68.3 s"),
    ],
)
def test_what_is_made_is_shown_beside_the_wish(steps, budget, shown):
    """A stream makes a least number of steps, and each frame takes one; a resumed run adds."""
    session = Mock(spec=TrainingSession, curve=[])
    session.trainer = Mock(
        steps=steps, config=SimpleNamespace(**budget), wall_seconds=7.0, frames_seen=9
    )
    session.coverage, session.meter = Mock(seen_share=0.5), Mock(is_paced=False, grows=False)
    with ExitStack() as cleanup:
        text = ConsoleReader(session, Console(), cleanup)._training_text()
    assert text.startswith(f"{shown} · ")

"""Checkpoints beside training: written on a thread, in turn, and as often as they may cost."""

import threading

import pytest

from avatar.training import checkpoint
from avatar.training.trainer import Trainer
from instant_avatar.run import snapshot_writer
from instant_avatar.run.run_folder import RunFolder
from instant_avatar.run.snapshot_writer import CheckpointWriter
from preprocess.capture_session import Capture

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

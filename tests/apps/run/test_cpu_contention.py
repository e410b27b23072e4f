"""Whether a machine gave a run the CPU time that it could have used."""

import pytest

from apps.run import run_timing
from apps.run.run_timing import CpuContentionMeter, CpuTime
from avatar.training.trainer import Trainer


@pytest.fixture
def trainer():
    """One that has made a hundred steps; nothing but its counts is looked at."""
    counted = Trainer.__new__(Trainer)
    counted.cpu_seconds, counted.steps = 4.0, 100
    counted.step_wall_seconds, counted.step_cpu_seconds = 5.0, 4.0
    return counted


def thread(tasks, number, *, ran_s, waited_s):
    folder = tasks / str(number)
    folder.mkdir(exist_ok=True)
    (folder / "schedstat").write_text(f"{ran_s * 10**9} {waited_s * 10**9} 77\n")


def test_threads_that_were_ready_and_had_no_core_are_counted(trainer, tmp_path, monkeypatch):
    """Those that ended meanwhile, or that sleep until a frame comes, are not."""
    monkeypatch.setattr(run_timing, "_throttled_s", lambda: 0.0)
    thread(tmp_path, 1, ran_s=9, waited_s=2)
    thread(tmp_path, 2, ran_s=1, waited_s=50)
    meter = CpuContentionMeter(trainer, tmp_path)
    (tmp_path / "2" / "schedstat").unlink()
    thread(tmp_path, 1, ran_s=20, waited_s=62)
    thread(tmp_path, 3, ran_s=7, waited_s=20)
    trainer.cpu_seconds, trainer.steps = 21.0, 234
    found = meter.measure()
    assert found == CpuTime(used_s=17.0, waited_s=80.0, steps=134)
    assert found.granted_share == pytest.approx(17.0 / 97.0)


def test_a_quota_that_holds_the_process_back_counts(trainer, tmp_path, monkeypatch):
    held_back = iter([3.0, 43.0])
    monkeypatch.setattr(run_timing, "_throttled_s", lambda: next(held_back))
    thread(tmp_path, 1, ran_s=9, waited_s=2)
    assert CpuContentionMeter(trainer, tmp_path).measure().waited_s == 40.0


def test_where_threads_say_nothing_steps_do(trainer, tmp_path):
    """A step that takes a second of wall time and a third of CPU time has waited."""
    meter = CpuContentionMeter(trainer, tmp_path / "none")
    trainer.step_wall_seconds, trainer.step_cpu_seconds = 65.0, 24.0
    trainer.cpu_seconds, trainer.steps = 26.0, 300
    assert meter.measure() == CpuTime(used_s=22.0, waited_s=40.0, steps=200)


def test_a_run_short_of_cpu_time_reports_the_missing_steps():
    said = CpuTime(used_s=17.0, waited_s=103.0, steps=134).warning()
    assert "17 of 120 core-seconds" in said
    assert "134 instead of about 946 steps" in said
    assert "--resume" in said


@pytest.mark.parametrize(("got_s", "waited_s"), [(60.0, 30.0), (60.0, 0.0), (0.0, 0.0), (0.5, 4.0)])
def test_a_run_that_got_most_of_it_or_was_short_hears_nothing(got_s, waited_s):
    assert CpuTime(used_s=got_s, waited_s=waited_s, steps=9).warning() is None

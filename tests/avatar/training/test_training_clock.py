"""Training time: what counts as such, and what does not."""

import time

import pytest

from avatar.config import TrainConfig
from avatar.training.train import TrainingClock
from avatar.training.trainer import Trainer


@pytest.fixture
def trainer(rig) -> Trainer:
    config = TrainConfig(rays=64, sample_step_m=0.03, finest_m=0.05, levels=2, table_size=1 << 10)
    return Trainer(rig, config)


@pytest.fixture
def spend(monkeypatch):
    """Lets seconds go by, of which the processor is busy for half."""
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(time, "process_time", lambda: now[0] / 2.0)

    def spend(seconds: float) -> None:
        now[0] += seconds

    return spend


def test_time_goes_on_from_where_an_earlier_run_stopped(trainer, spend):
    trainer.wall_seconds, trainer.cpu_seconds = 5.0, 3.0
    clock = TrainingClock(trainer)
    spend(4.0)
    assert clock.read() == trainer.wall_seconds == 9.0
    assert trainer.cpu_seconds == 5.0


def test_a_pause_does_not_count_before_the_clock_within_it_or_if_it_ends_badly(trainer, spend):
    def pause(error: type[BaseException] | None = None) -> None:
        with trainer.paused():
            spend(60.0)
            if error:
                raise error

    pause()
    clock = TrainingClock(trainer)
    spend(2.0)
    pause()
    with pytest.raises(KeyboardInterrupt):
        pause(KeyboardInterrupt)
    spend(1.0)
    assert clock.read() == 3.0
    assert trainer.cpu_seconds == 1.5

"""Training: what it reaches, that it never falls back, what it says on the way, and its time."""

import dataclasses
import itertools
import threading
import time

import numba
import numpy as np
import pytest
import torch

from avatar import avatar_model
from avatar.config import NOMINAL_STEPS_PER_S, TrainConfig
from avatar.events import (
    Evaluated,
    Finished,
    FrameArrived,
    FrameLeftOut,
    Presentable,
    Stepped,
    WaitingForFrame,
)
from avatar.kernels import numba_shading, numba_training_step
from avatar.kernels.numba_pose import add_rays
from avatar.kernels.numba_rendering import march
from avatar.kernels.numba_shading import add_light
from avatar.training import pose_optimizer
from avatar.training import train as train_module
from avatar.training.frame_stream import TrainingFrame, prepare_stream
from avatar.training.train import TrainingClock, train
from avatar.training.trainer import Trainer
from capture.inbox import Inbox
from preprocess.observation import DroppedFrame

QUICK = TrainConfig(
    rays=128, sample_step_m=0.03, finest_m=0.05, levels=3, table_size=1 << 12,
    empty_space_points=32, seconds=60.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def ready(rig, clip):
    """Prepared frames 0 … 7, where 2 and 5 are held out and 4 is left out."""
    observations = [*clip.observations[:4], DroppedFrame(index=4, reason="empty mask")]
    observations += clip.observations[5:8]
    return list(prepare_stream(iter(observations), rig, stride=3, total=None))


def taught(rig, ready, config):
    """A trainer that was taught by `train`, its held-out frames and its events."""
    trainer, held = Trainer(rig, config), []
    return trainer, held, list(train(trainer, Inbox(ready), held))


@pytest.fixture(scope="module")
def frames(ready):
    """Those of them that are trained on."""
    return [item for item in ready if isinstance(item, TrainingFrame)]


@pytest.fixture(scope="module")
def short(rig, ready):
    """Training of 25 steps: trainer, held-out frames, events, and the rate at each step."""
    trainer, held, events, rates = Trainer(rig, dataclasses.replace(QUICK, steps=25)), [], [], []
    for event in train(trainer, Inbox(ready), held):
        events.append(event)
        if isinstance(event, Stepped):
            rates.append(trainer.optimizer.param_groups[0]["lr"])
    return trainer, held, events, rates


@pytest.fixture
def ticking(monkeypatch):
    """A clock that goes on by 5 ms each time it is read: time that no other program can take."""
    ticks = itertools.count()
    monkeypatch.setattr(time, "perf_counter", lambda: 0.005 * next(ticks))


# --- what it reaches --------------------------------------------------------------------------


def test_frames_and_a_pose_it_has_never_seen_are_rendered_well(learnt):
    last = [score.psnr for score in learnt.marks[-1][:-1]]
    assert np.mean(last) > 32.0
    assert min(last) > 31.0
    assert np.mean([score.ssim for score in learnt.marks[-1][:-1]]) > 0.98
    assert learnt.marks[-1][-1].psnr > 28.0  # the pose


def test_no_frame_ever_falls_back(learnt):
    """An occupancy that forgot thin surfaces, and rays cut too early, once cost 15 dB."""
    scores = np.array([[score.psnr for score in mark] for mark in learnt.marks])
    best = np.maximum.accumulate(scores, axis=0)
    assert (best - scores).max() < 1.0


def test_rays_need_few_samples(learnt):
    """Without cells and occupancy a ray would have about a hundred."""
    assert learnt.trainer.samples / learnt.trainer.rays < 12.0


# --- what the generator does and says ---------------------------------------------------------


def test_every_usable_frame_is_taken_in_and_the_others_are_kept_out(short):
    trainer, held, events, _ = short
    assert trainer.frames_seen == 5
    assert trainer.replay.frame_indices == [0, 1, 3, 6, 7]
    assert [frame.observation.frame.index for frame in held] == [2, 5]
    arrived = [(event.index, event.held_out) for event in events if isinstance(event, FrameArrived)]
    assert arrived == [
        (0, False), (1, False), (2, True), (3, False), (5, True), (6, False), (7, False),
    ]  # fmt: skip
    left_out = [event for event in events if isinstance(event, FrameLeftOut)]
    assert left_out == [FrameLeftOut(index=4, reason="empty mask")]


def test_events_come_in_order_and_end_with_the_last_step(short):
    trainer, _, events, _ = short
    steps = [event for event in events if isinstance(event, Stepped)]
    finished = events[-1]
    assert isinstance(finished, Finished)
    assert sum(isinstance(event, Finished) for event in events) == 1
    assert [event.step for event in steps] == list(range(1, 26))
    for before, after in itertools.pairwise(steps):
        assert before.wall_seconds <= after.wall_seconds <= finished.wall_seconds
        assert before.frames_seen <= after.frames_seen
    assert finished.steps == trainer.steps == 25
    assert finished.rays == trainer.rays == 25 * QUICK.rays
    assert finished.samples == trainer.samples
    per_ray = sum(event.samples_per_ray for event in steps)
    assert per_ray * QUICK.rays == pytest.approx(finished.samples)


def test_it_stops_when_the_time_is_up(rig, ready, ticking):
    trainer, inbox = Trainer(rig, dataclasses.replace(QUICK, seconds=0.4)), Inbox(ready)
    inbox._thread.join()  # the last frame comes before the first step
    events = list(train(trainer, inbox, []))
    steps = [event for event in events if isinstance(event, Stepped)]
    late = [step for step in steps if step.wall_seconds >= 0.4]
    assert len(late) <= 1 or len(steps) == train_module.MIN_STEPS_AFTER_LAST_FRAME
    assert events[-1].wall_seconds >= 0.4


def test_held_out_frames_that_have_arrived_are_scored_at_the_marks(rig, ready, monkeypatch):
    marks_s = 1 / 50, 10 / 50, 60.0  # after 1 and 10 steps
    monkeypatch.setattr(train_module, "EVALUATION_TIMES_S", marks_s)
    _, _, events = taught(rig, ready, dataclasses.replace(QUICK, steps=12))
    marks = [event for event in events if isinstance(event, Evaluated)]
    assert [mark.frames_seen for mark in marks] == [2, 5]
    assert [[score.frame for score in mark.scores] for mark in marks] == [[], [2, 5]]
    assert np.isfinite([score.psnr for score in marks[1].scores]).all()


def test_scoring_at_a_mark_stops_when_its_time_is_spent(rig, ready, monkeypatch, ticking):
    monkeypatch.setattr(train_module, "EVALUATION_TIMES_S", (0.05, 60.0))
    monkeypatch.setattr(train_module, "EVALUATION_TIME_SHARE", 0.0)
    trainer, held = Trainer(rig, dataclasses.replace(QUICK, seconds=0.5)), []
    inbox = Inbox(ready)
    inbox._thread.join()  # all frames are there before the first mark
    (mark,) = [event for event in train(trainer, inbox, held) if isinstance(event, Evaluated)]
    assert len(held) == 2
    assert len(mark.scores) == 1


def test_the_rate_is_constant_until_the_last_frame_and_falls_after(rig, frames, ticking):
    gate = threading.Event()

    def arriving():
        yield from frames[:2]
        gate.wait(10.0)
        yield frames[2]

    config = dataclasses.replace(QUICK, seconds=0.8)
    trainer, rates = Trainer(rig, config), {1: [], 2: [], 3: []}
    for event in train(trainer, Inbox(arriving()), []):
        if isinstance(event, Stepped):
            group = trainer.optimizer.param_groups[0]
            rates[event.frames_seen].append(group["lr"])
            if event.step == 10:
                gate.set()
    assert set(rates[1] + rates[2]) == {config.learning_rate}
    falling = np.array(rates[3][1:])
    assert (np.diff(falling) <= 0.0).all()
    assert falling[0] > 0.9 * config.learning_rate
    assert falling[-1] < 0.1 * config.learning_rate


def test_a_stream_without_a_usable_frame_ends_without_a_step(rig):
    nothing = [DroppedFrame(index=index, reason="pose invalid") for index in range(3)]
    trainer, _, events = taught(rig, nothing, QUICK)
    assert [type(event) for event in events if not isinstance(event, WaitingForFrame)] == [
        FrameLeftOut
    ] * 3
    assert trainer.steps == 0


# --- frames that come at times of their own ----------------------------------------------------


def rates_by_frames(rig, frames, *, seconds, opens_after_s, all_came=False):
    """The learning rates of the steps after each number of frames: the second comes late."""
    gate = threading.Event()

    def arriving():
        yield frames[0]
        gate.wait(10.0)
        yield from frames[1:3]

    trainer = Trainer(rig, dataclasses.replace(QUICK, seconds=seconds))
    inbox = Inbox(arriving(), paced=True, all_came=lambda: all_came)
    rates = {1: [], 2: [], 3: []}
    for event in train(trainer, inbox, []):
        if isinstance(event, Stepped):
            rates[event.frames_seen].append(trainer.optimizer.param_groups[0]["lr"])
            if event.wall_seconds > opens_after_s:
                gate.set()
    return rates, trainer


@pytest.mark.parametrize(
    ("seconds", "opens_after_s", "least_steps", "ends_after_s"),
    [
        (0.4, 0.8, 60, 0.9),  # the last frame comes after the time that was given
        (1.0, 0.0, 0, 1.0),  # seconds are left
    ],
)
def test_after_the_last_frame_of_a_film_that_comes_rates_fall_for_a_while(
    rig, frames, ticking, monkeypatch, seconds, opens_after_s, least_steps, ends_after_s
):
    """Read as fast as possible, reading would come first after half of the time."""
    monkeypatch.setattr(train_module, "LEAST_STEPS", least_steps)
    monkeypatch.setattr(train_module, "CLOSING_S", 0.1)
    rates, trainer = rates_by_frames(rig, frames, seconds=seconds, opens_after_s=opens_after_s)
    assert set(rates[1] + rates[2]) == {train_module.STREAMING_RATE_FACTOR * QUICK.learning_rate}
    assert (np.diff(rates[3][1:]) <= 0.0).all()
    assert rates[3][-1] < 0.1 * QUICK.learning_rate
    assert len(rates[3]) >= train_module.MIN_STEPS_AFTER_LAST_FRAME
    assert trainer.steps >= least_steps  # however short the film is
    assert trainer.wall_seconds >= ends_after_s


def test_rates_fall_from_the_end_of_the_film_on_while_its_frames_still_come(
    rig, frames, ticking, monkeypatch
):
    """The last frame comes late: it is learnt for a while, too."""
    monkeypatch.setattr(train_module, "LEAST_STEPS", 0)
    monkeypatch.setattr(train_module, "CLOSING_S", 0.1)
    monkeypatch.setattr(train_module, "LATE_FRAMES_S", 0.3)
    rates, _ = rates_by_frames(rig, frames, seconds=0.4, opens_after_s=0.8, all_came=True)
    before = np.array(rates[1] + rates[2])
    assert 0.0 < before[-1] < 0.9 * before[0]
    assert (np.diff(before) <= 0.0).all()
    assert rates[3][-1] < 0.1 * QUICK.learning_rate
    assert len(rates[3]) >= train_module.MIN_STEPS_AFTER_LAST_FRAME


def test_a_live_source_is_left_when_the_time_is_up(rig, frames, ticking, monkeypatch):
    monkeypatch.setattr(train_module, "LEAST_STEPS", 0)
    monkeypatch.setattr(train_module, "CLOSING_S", 0.1)
    closed = threading.Event()

    def never_ending():
        yield from frames[:2]
        closed.wait(30.0)

    trainer = Trainer(rig, dataclasses.replace(QUICK, seconds=0.4))
    inbox = Inbox(never_ending(), paced=True, live=True)
    events = list(train(trainer, inbox, []))
    closed.set()
    inbox.close()
    assert isinstance(events[-1], Finished)
    assert trainer.wall_seconds >= 0.4
    assert trainer.steps >= train_module.MIN_STEPS_AFTER_LAST_FRAME


def test_training_ends_with_the_last_image_of_a_folder_that_grows(
    rig, frames, ticking, monkeypatch
):
    monkeypatch.setattr(train_module, "LEAST_STEPS", 0)
    monkeypatch.setattr(train_module, "CLOSING_S", 0.6)
    monkeypatch.setattr(train_module, "EVALUATION_TIMES_S", (0.3, 60.0))
    trainer = Trainer(rig, dataclasses.replace(QUICK, seconds=3600.0))
    inbox = Inbox(frames[:2], paced=True, ends_run=True)
    inbox._thread.join()  # all frames are there before the mark
    events = list(train(trainer, inbox, []))
    assert not any(isinstance(event, Evaluated) for event in events)  # a user waits
    (shown,) = (place for place, event in enumerate(events) if isinstance(event, Presentable))
    before, after = (
        sum(isinstance(event, Stepped) for event in part)
        for part in (events[:shown], events[shown:])
    )
    assert before > 0
    assert after > 0
    assert isinstance(events[-1], Finished)
    assert events[-1].wall_seconds > 0.3
    assert trainer.steps >= train_module.MIN_STEPS_AFTER_LAST_FRAME


def test_while_nothing_has_come_the_listener_is_heard(rig):
    """So that Ctrl-C ends a run that waits for its first frame."""
    closed = threading.Event()

    def nothing():
        closed.wait(30.0)
        yield from ()

    inbox = Inbox(nothing(), paced=True, live=True)
    assert isinstance(next(train(Trainer(rig, QUICK), inbox, [])), WaitingForFrame)
    closed.set()
    inbox.close()


def test_corrections_of_frames_that_are_gone_are_forgotten(rig, frames):
    config = dataclasses.replace(QUICK, replay_capacity=3)
    trainer = Trainer(rig, config)
    for index in range(40):
        trainer.add_frame(dataclasses.replace(frames[0], index=index))
        trainer.pose_corrections[index] = np.full((25, 3), float(index))
    assert len(trainer.pose_corrections) <= 2 * config.replay_capacity + 1
    assert set(trainer.replay.frame_indices) <= set(trainer.pose_corrections)


# --- steps instead of seconds -----------------------------------------------------------------


@pytest.fixture
def one_thread():
    threads = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(1)
    torch.set_num_threads(1)
    yield
    numba.set_num_threads(threads[0])
    torch.set_num_threads(threads[1])


def taught_at_a_pace(rig, ready, config, *, pause_s):
    """What training makes of frames that each take so long to prepare."""

    def arriving():
        for item in ready:
            time.sleep(pause_s)
            yield item

    trainer = Trainer(rig, config)
    events = train(trainer, Inbox(arriving()), [])
    frames_seen = [event.frames_seen for event in events if isinstance(event, Stepped)]
    grid = trainer.avatar.occupancy.density_grid
    return frames_seen, [*trainer.avatar.field.parameters(), grid.density, grid.occupied]


@pytest.mark.usefixtures("one_thread")
def test_counted_steps_and_one_seed_give_one_avatar_however_fast_frames_come(rig, ready):
    config = dataclasses.replace(QUICK, steps=12)
    other = taught_at_a_pace(rig, ready, dataclasses.replace(config, seed=1), pause_s=0.0)
    at_once, slowly = (taught_at_a_pace(rig, ready, config, pause_s=s) for s in (0.0, 0.03))
    assert at_once[0] == slowly[0] == [1, 2, 3, 4] + [5] * 8
    for a, b in zip(at_once[1], slowly[1], strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(at_once[1][0], other[1][0])


def test_each_frame_is_learnt_from_even_if_there_are_fewer_steps(rig, ready):
    trainer, _, events = taught(rig, ready, dataclasses.replace(QUICK, steps=2))
    assert trainer.frames_seen == trainer.steps == 5
    assert isinstance(events[-1], Finished)


def test_the_rate_falls_with_the_steps_that_are_left(short):
    config, rates = short[0].config, short[3]
    assert config.seconds == 25 / NOMINAL_STEPS_PER_S
    assert rates[:5] == [config.learning_rate] * 5
    assert (np.diff(rates[5:]) <= 0.0).all()
    assert rates[-1] < 0.1 * config.learning_rate


def test_two_processes_that_compile_halves_compile_what_a_step_calls(rig, monkeypatch):
    """Also what neither an exact pose nor a light that is not known yet would call."""
    monkeypatch.setattr(train_module, "WARM_THREADS", set())
    called: list[str] = []
    for module, name in (
        (pose_optimizer, "largest_distance"),
        (avatar_model, "light_factors"),
        (numba_shading, "mean_normals"),
    ):
        kernel = getattr(module, name)
        spy = lambda *a, kernel=kernel, name=name: (called.append(name), kernel(*a))[1]  # noqa: E731
        monkeypatch.setattr(module, name, spy)
    trainer = Trainer(rig, TrainConfig())
    train_module.warm_up_learning(trainer)
    train_module.warm_up_rays(trainer)
    halves = (numba_training_step.learn, add_rays, add_light, march)
    compiled = [set(kernel.overloads) for kernel in halves]
    train_module.warm_up(trainer)
    assert [set(kernel.overloads) for kernel in halves] == compiled
    assert set() not in compiled
    assert set(called) == {"largest_distance", "light_factors", "mean_normals"}
    assert called[-1] == "largest_distance"  # the mark of a whole first run


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

"""Online training: compiles the kernels, then trains an avatar while frames arrive."""

import dataclasses
import itertools
import threading
import time
from collections.abc import Iterator
from typing import final

import numpy as np
import torch
from jaxtyping import UInt8

from avatar.avatar_model import OBSERVATION_INTERVAL
from avatar.evaluation.held_out import (
    FRAMES_PER_EVALUATION,
    HeldOutFrame,
    PixelSample,
    add_held_out,
    coarse_to_fine_order,
    subsample_evenly,
)
from avatar.events import (
    Evaluated,
    Finished,
    FrameArrived,
    FrameLeftOut,
    HeldOutScore,
    Presentable,
    Stepped,
    TrainEvent,
    WaitingForFrame,
    Warned,
)
from avatar.kernels import operations
from avatar.kernels.operands import LossSettings, PosedBones, PriorPoints, RayBatch, RaySamples
from avatar.render import render
from avatar.training.frame_stream import RedundantFrame, StreamItem, rebuild_frame
from avatar.training.pose_optimizer import FIRST_CORRECTION_STEPS
from avatar.training.trainer import Trainer, cosine_decay
from avatar.training.training_pixels import RayView
from capture.camera import Camera
from capture.inbox import Inbox
from preprocess.body.body_pose import BodyPose
from preprocess.observation import DroppedFrame

MIN_STEPS_AFTER_LAST_FRAME = 20
"""Fewest steps after the last frame, whose rays are drawn first."""
STREAMING_RATE_FACTOR = 0.5
"""Factor of the learning rates while a video plays in real time: without a falling rate, smaller
swings of the parameters leave their mean closer to the optimum."""
CLOSING_S = 2.0
"""Time after the last frame of a paced source in which rates fall and surfaces become firm,
seconds: a user waits."""
LATE_FRAMES_S = 0.5
"""Time for which frames are learnt that come while rates are falling, seconds."""
LEAST_STEPS = 250
"""Steps that a paced source is trained for, however short it is; fewer make no surface."""
EVALUATION_TIME_SHARE = 0.004
"""Share of the time budget that one evaluation may take; it scores at least one frame. A minute
has seven of them: 3 % at most."""
EVALUATION_TIMES_S = (2.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0)
"""Schedule times of the learning curve, seconds; 30 s apart after the last."""


@final
class TrainingClock:
    """Training time, wall and CPU, continued from earlier runs and without pauses.

    The schedule (learning rates, evaluations, the end) follows wall time or, where the
    configuration counts steps, the steps made; it is then the same on every machine.
    """

    def __init__(self, trainer: Trainer) -> None:
        """Starts now."""
        self._trainer = trainer
        self._wall = time.perf_counter() - trainer.wall_seconds - trainer.paused_wall_seconds
        self._cpu = time.process_time() - trainer.cpu_seconds - trainer.paused_cpu_seconds

    def read(self) -> float:
        """Updates the trainer's wall and CPU seconds; returns its position in the schedule, s."""
        trainer = self._trainer
        trainer.wall_seconds = time.perf_counter() - self._wall - trainer.paused_wall_seconds
        trainer.cpu_seconds = time.process_time() - self._cpu - trainer.paused_cpu_seconds
        return trainer.scheduled_seconds


def train(
    trainer: Trainer, inbox: Inbox[StreamItem], held_out: list[HeldOutFrame]
) -> Iterator[TrainEvent]:
    """Trains on the frames that have arrived until the time, or the steps, are used up.

    The learning rate is constant while frames arrive and falls as a cosine after the last one; of a
    paced source for `CLOSING_S`, if no more time is left, while skipped frames still come. No frame
    of a recording is lost: if the time is too short to read them all beside training, reading takes
    precedence and may overrun the time. Frames of a paced source are not waited for, except for the
    first. A live source is left when the time is up, and training closes with the last frame of a
    folder that grows, from which on nothing is scored. Where steps are counted, one more frame of a
    recording is read before each step until all are read.

    Held-out frames that arrive are appended to `held_out`. Events are yielded on the caller's
    thread; the time the caller spends on one counts as training time unless it pauses the trainer.
    """
    stream, marks = _FrameIntake(trainer, inbox, held_out), _EvaluationSchedule(trainer)
    while True:
        now = stream.clock.read()
        yield from stream.receive(now)
        if len(trainer.replay) == 0:
            if stream.ended:
                return
            yield WaitingForFrame()
            continue
        now = stream.clock.read()
        if stream.is_done(now):
            break
        if stream.is_presentable(now):
            yield Presentable()
            continue
        if marks.is_due(now) and not stream.is_closing:
            yield marks.score(held_out, stream.clock)
            continue
        if stream.is_behind(now) or stream.needs_frame():
            continue
        yield _train_step(trainer, stream, now)
    yield from _finish(trainer, paced=inbox.paced)


def _train_step(trainer: Trainer, stream: "_FrameIntake", now: float) -> Stepped:
    falling, done = cosine_decay(stream.progress(now)), stream.share_done(now)
    cpu = time.process_time()
    result = trainer.step(
        rate=min(falling, stream.highest_rate),
        pose_rate=falling,
        hard_surface_share=min(1.0, 4.0 * done),
        detail_share=1.0 - cosine_decay(done),
    )
    trainer.step_cpu_seconds += time.process_time() - cpu
    stream.clock.read()
    return Stepped(
        step=trainer.steps,
        wall_seconds=trainer.wall_seconds,
        loss=float(result.loss.mean()),
        samples_per_ray=result.sample_count / trainer.config.rays,
        frames_seen=trainer.frames_seen,
    )


def _finish(trainer: Trainer, *, paced: bool) -> Iterator[Warned | Finished]:
    config = trainer.config
    if trainer.wall_seconds > 1.1 * config.seconds and not (config.steps or paced):
        yield Warned(
            message=f"Reading the video took longer than the {config.seconds:g} s that were "
            f"given: training ended after {trainer.wall_seconds:.0f} s, when every frame had been "
            "learnt from once. Give more --seconds, or fewer --frames."
        )
    yield Finished(
        wall_seconds=trainer.wall_seconds,
        cpu_seconds=trainer.cpu_seconds,
        steps=trainer.steps,
        rays=trainer.rays,
        samples=trainer.samples,
    )


@final
class _FrameIntake:
    """Hands arriving frames to the trainer, and tracks the end of the stream."""

    def __init__(
        self, trainer: Trainer, inbox: Inbox[StreamItem], held_out: list[HeldOutFrame]
    ) -> None:
        self._trainer, self._inbox, self._held_out = trainer, inbox, held_out
        self._began = trainer.scheduled_seconds
        self._closing_from: float | None = None
        self._ended_at: float | None = None
        self._steps_before_closing = self._least_steps = 0
        self._was_presentable = False
        self._last_frame_step: int | None = None
        self.clock = TrainingClock(trainer)
        self._started = len(trainer.replay) > 0  # a resumed run remembers frames

    @property
    def highest_rate(self) -> float:
        """Upper bound of the learning rates' factor."""
        return STREAMING_RATE_FACTOR if self._inbox.paced else 1.0

    @property
    def ended(self) -> bool:
        return self._ended_at is not None

    @property
    def is_closing(self) -> bool:
        """True if the last frame has come of a source that ends the run: a user waits."""
        return self._inbox.ends_run and self._closing_from is not None

    def is_presentable(self, now: float) -> bool:
        """True once, where a user waits for the avatar of a paced source."""
        waits = self._inbox.paced and self.is_closing and not self._was_presentable
        self._was_presentable |= waits and self.progress(now) >= 0.5
        return waits and self._was_presentable

    def receive(self, now: float) -> Iterator[FrameArrived | FrameLeftOut]:
        """Adds the frames that have arrived to the trainer; the clock starts with the first."""
        if self.ended or (
            self._one_frame_per_step and self._last_frame_step == self._trainer.steps
        ):
            return
        # without a frame, or where reading comes first, the reader has the machine for a moment
        waits = self._one_frame_per_step or self.is_behind(now) or len(self._trainer.replay) == 0
        most = 1 if self._one_frame_per_step else None
        taken = self._inbox.take(timeout_s=0.1 if waits else 0.0, max_items=most)
        for item in taken:
            yield from self._accept(item)
        if taken and self._one_frame_per_step:  # whether that was the last item depends on threads
            return
        too_late = self._inbox.live and self._started and now >= self._trainer.config.seconds
        if self._inbox.finished or too_late:
            self._ended_at = self.clock.read()
        if self._closing_from is None and (self.ended or self._inbox.all_came()):
            self._closing_from = self.clock.read()
            if self._inbox.paced:
                self._steps_before_closing, self._least_steps = self._trainer.steps, LEAST_STEPS

    def _accept(self, item: StreamItem) -> Iterator[FrameArrived | FrameLeftOut]:
        if isinstance(item, DroppedFrame):
            yield FrameLeftOut(index=item.index, reason=item.reason)
            return
        if isinstance(item, RedundantFrame):
            return
        if not self._started:
            self.clock, self._started = TrainingClock(self._trainer), True
        if isinstance(item, HeldOutFrame):
            add_held_out(self._held_out, item)
            yield FrameArrived(index=item.observation.frame.index, held_out=True)
            return
        self._trainer.add_frame(item)
        self._last_frame_step = self._trainer.steps
        yield FrameArrived(index=item.index, held_out=False)

    @property
    def _one_frame_per_step(self) -> bool:
        """True if one frame is read per step, which makes a run reproducible."""
        return bool(self._trainer.config.steps) and not self._inbox.paced

    def needs_frame(self) -> bool:
        """True if the next step has to wait for one more frame."""
        return (
            self._one_frame_per_step
            and not self.ended
            and self._last_frame_step != self._trainer.steps
        )

    def is_behind(self, now: float) -> bool:
        """True if reading takes precedence over training; a paced source cannot be hurried."""
        if self._one_frame_per_step:
            return False
        began, end = self._began, self._trainer.config.seconds
        late = now > began + 0.5 * (end - began)
        return late and not (self.ended or self._inbox.paced)

    def is_done(self, now: float) -> bool:
        """True if the schedule is over and every frame has been trained on."""
        config, admitted_at = self._trainer.config, self._last_frame_step
        if not self.ended or now < self._end(now):
            return False
        farewell = 0 if config.steps or admitted_at is None else MIN_STEPS_AFTER_LAST_FRAME
        return self._trainer.steps >= max((admitted_at or 0) + farewell, self._least_steps)

    def _end(self, now: float) -> float:
        """The time at which training ends; it moves on while frames come."""
        end = self._trainer.config.seconds
        if self._closing_from is None or not self._inbox.paced:
            return end
        last = now if self._ended_at is None else self._ended_at
        least = 0.0 if self._inbox.ends_run else end
        return max(least, self._closing_from + CLOSING_S, last + LATE_FRAMES_S)

    def progress(self, now: float) -> float:
        """Elapsed share of the time in which rates fall, in [0, 1]; 0 before it."""
        if self._closing_from is None:
            return 0.0
        in_time = (now - self._closing_from) / max(self._end(now) - self._closing_from, 1e-6)
        left = self._least_steps - self._steps_before_closing
        made = self._trainer.steps - self._steps_before_closing
        return in_time if left <= 0 else min(in_time, made / left)

    def share_done(self, now: float) -> float:
        """Elapsed share of the schedule, of which only the end of a film that comes is known."""
        return max(now / self._trainer.config.seconds, self.progress(now))


@final
class _EvaluationSchedule:
    """Times of the learning curve's evaluations, and how long each may take."""

    def __init__(self, trainer: Trainer) -> None:
        self._trainer = trainer
        self._times = _evaluation_times(after=trainer.scheduled_seconds)
        self._next = next(self._times)
        self._samples: dict[int, PixelSample] = {}

    def is_due(self, now: float) -> bool:
        return now >= self._next

    def score(self, held_out: list[HeldOutFrame], clock: TrainingClock) -> Evaluated:
        """Scores samples of held-out frames, evenly over the stream, until the time is spent."""
        trainer, scores = self._trainer, list[HeldOutScore]()
        at, cpu_at = trainer.wall_seconds, trainer.cpu_seconds
        enough = clock.read() + EVALUATION_TIME_SHARE * trainer.config.seconds
        for frame in coarse_to_fine_order(subsample_evenly(held_out, FRAMES_PER_EVALUATION)):
            if scores and clock.read() > enough:
                break
            scores.append(self._sample(frame).score(trainer.avatar))
        now = clock.read()
        self._next = next(time for time in self._times if time > now)
        return Evaluated(
            wall_seconds=at,
            cpu_seconds=cpu_at,
            frames_seen=trainer.frames_seen,
            scores=tuple(scores),
        )

    def _sample(self, frame: HeldOutFrame) -> PixelSample:
        """The frame's sample, which later evaluations find again; bounded in number."""
        index = frame.observation.frame.index
        kept = self._samples.pop(index, None)
        if kept is None:
            while len(self._samples) >= 2 * FRAMES_PER_EVALUATION:
                del self._samples[next(iter(self._samples))]
            kept = PixelSample.of(frame).with_correspondences(self._trainer.avatar.rig)
        self._samples[index] = kept
        return kept


def _evaluation_times(*, after: float) -> Iterator[float]:
    later = itertools.count(EVALUATION_TIMES_S[-1] + 30.0, 30.0)
    return (mark for mark in itertools.chain(EVALUATION_TIMES_S, later) if mark > after)


WARMUP_IMAGE_PX = 16
WARM_THREADS = set[int]()
"""Threads that have every kernel."""


def warm_up(trainer: Trainer) -> float:
    """Compiles, or loads from disk, every kernel that training and rendering use.

    Runs on the thread that will train; a second time on one thread does nothing. The trainer
    itself is not changed. Returns the seconds that it took: tens on a machine's first run, about
    one later.
    """
    began, thread = time.perf_counter(), threading.get_ident()
    if thread in WARM_THREADS:
        return 0.0
    WARM_THREADS.add(thread)
    stand_in = warm_up_rays(trainer)
    stand_in.steps = FIRST_CORRECTION_STEPS
    for _ in range(stand_in.config.occupancy_interval):
        stand_in.step(rate=1.0, hard_surface_share=1.0)
    stand_in.poses.needs_resolve(0)  # a first run ends with this kernel
    return time.perf_counter() - began


def warm_up_rays(trainer: Trainer) -> Trainer:
    """Compiles rendering, and of a step what is not learning; returns a trainer with one frame."""
    stand_in = _small_trainer(trainer)
    rig = stand_in.avatar.rig
    eye, size = rig.rest_joints[0] + [0.0, 0.0, 3.0], (WARMUP_IMAGE_PX, WARMUP_IMAGE_PX)
    camera = Camera.at(eye, np.diag([1.0, -1.0, -1.0]), 1.5 * WARMUP_IMAGE_PX, size)
    view = RayView.of(camera, np.full(size, True))
    colors: UInt8[np.ndarray, "pixels 4"] = np.full((WARMUP_IMAGE_PX**2, 4), 255, dtype=np.uint8)
    stand_in.avatar.shading.restore(torch.tensor([1.0, 0.1, 0.0, 0.0]))
    render(stand_in.avatar, BodyPose.rest(), camera, shaded=True)
    stand_in.add_frame(rebuild_frame(0, BodyPose.rest(), view, colors, rig))
    poses = stand_in.poses  # an exact pose does not move, and nothing would have followed it
    operations.update_roots(stand_in.replay.correspondences, [0], poses.skinning, poses.bones)
    batch = stand_in.replay.sample_rays(stand_in.config.rays, stand_in.generator)
    stand_in.exposures.neutralize(batch)
    count = stand_in.config.rays
    stand_in.exposures.observe(batch, torch.zeros(count, 4))
    for _ in range(OBSERVATION_INTERVAL):
        stand_in.learner.shading.observe(torch.zeros(count, 3), batch.target, torch.zeros(count, 4))
    poses.accumulate(batch.rays.slots, torch.zeros(count, 24, 6), torch.zeros(count))
    return stand_in


def warm_up_learning(trainer: Trainer) -> None:
    """Compiles `operations.learn`, on no rays: half of all compilation.

    `warm_up` comes to it late; a process can begin with it while another one warms rays up.
    """
    stand_in = _small_trainer(trainer)
    none, nowhere, poses = torch.zeros(0), torch.zeros(0, 3), stand_in.poses
    no_rows = torch.zeros(0, dtype=torch.int32)
    operations.learn(
        RayBatch(nowhere, nowhere, no_rows, none), torch.zeros(0, 4), torch.zeros(0, 3, 3),
        RaySamples(nowhere, torch.zeros(0, dtype=torch.int64), no_rows, no_rows),
        stand_in.replay.correspondences,
        PriorPoints([nowhere] * 7, none, np.zeros((7, 2), dtype=np.float32), 1.0),
        stand_in.learner.shading.lit_skin(), PosedBones(poses.skinning, poses.bones, 1), 0,
        stand_in.field.table, stand_in.field.levels, stand_in.field.network,
        LossSettings(1.0, 1.0, 1.0, 1.0),
    )  # fmt: skip


def _small_trainer(trainer: Trainer) -> Trainer:
    """A trainer of the same person, whose steps are short."""
    config = dataclasses.replace(trainer.config, rays=64, empty_space_points=16, density_tv_pairs=8)
    return Trainer(trainer.avatar.rig, config)

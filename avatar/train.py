"""The online trainer: improves an avatar while frames arrive, and says what happens."""

import time
from collections.abc import Iterator
from typing import final

import numpy as np
import torch
from jaxtyping import Float

from avatar.cells import WarpCells
from avatar.config import COARSEST_M, TrainConfig
from avatar.events import Evaluated, Finished, Score, Stepped, TrainEvent, Warned
from avatar.field import Field
from avatar.hold import SCORED_AT_A_MARK, HeldOut, interleaved, score, spread
from avatar.kernels.backend import Backend, backend_for
from avatar.levels import HashLevels
from avatar.model import Avatar
from avatar.occupancy import DECAY, FIRST_DECAY, Occupancy
from avatar.prepare import PreparedFrame
from avatar.refine import PoseTable
from avatar.replay import Replay
from avatar.rig import Rig
from avatar.step import StepResult, cosine, gradients
from capture.inbox import Inbox
from preprocess.observe import Dropped

NETWORK_RATE = 0.3
"""The network's learning rate as a share of the table's."""
CLEARING_STEPS = 300
"""Steps during which the first fog clears: the occupancy is probed more and forgets faster."""
REFINED_AFTER_STEPS = 150
"""Poses are corrected once there is something to compare them with."""
CORRECTIONS_PER_STEP = 2
READING_SHARE = 0.5
"""Share of the time after which a video that is still being read comes before training."""
FAREWELL_STEPS = 20
"""Steps after the last frame, at the least: a new frame's rays are drawn first."""
SCORING_SHARE = 0.015
"""Share of the whole time that scoring at one mark may take (at least one frame is scored)."""
MARKS_S = (2.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0)
"""When the curve is measured, in seconds of training; then every 30 s."""


@final
class Trainer:
    """Everything that training changes, and one step of it.

    Attributes:
        avatar: As it stands.
        config: The recipe.
        replay: The frames it learns from.
        poses: Their poses, corrected if the recipe says so.
        corrections: How each frame's pose was corrected, by the frame's number in its source; a
            frame that comes again starts from there. Clear it before another source is read.
        steps, rays, samples: How much has been done.
        wall_seconds, cpu_seconds: Training time so far; a resumed run goes on counting.
        frames_seen: Frames taken in so far, whether or not they are still kept.
    """

    def __init__(self, rig: Rig, config: TrainConfig, device: torch.device) -> None:
        """A trainer that has seen nothing."""
        self.config = config
        self.backend: Backend = backend_for(device)
        levels = HashLevels.over(
            rig.box_low, rig.box_high, coarsest_m=COARSEST_M, finest_m=config.finest_m,
            levels=config.levels, table_size=config.table_size,
        )  # fmt: skip
        start = torch.Generator().manual_seed(config.seed)
        field = Field(levels, self.backend, device, start)
        self.avatar = Avatar(
            rig=rig, field=field, occupancy=Occupancy(rig, device), step_m=config.step_m
        )
        self.replay = Replay(config.key_frames, device)
        self.poses = PoseTable(rig, config.key_frames, device)
        self.corrections: dict[int, Float[np.ndarray, "25 3"]] = {}
        self.steps = self.rays = self.samples = self.frames_seen = 0
        self.wall_seconds = self.cpu_seconds = 0.0
        self._generator = torch.Generator(device=device).manual_seed(config.seed)
        rate = config.learning_rate
        self.optimizer = torch.optim.Adam(
            [
                {"params": [field.table], "lr": rate, "eps": 1e-15},
                {"params": field.layers, "lr": rate * NETWORK_RATE},
            ],
            betas=(0.9, 0.99),
            fused=True,
        )

    def add(self, frame: PreparedFrame, *, again: bool = False) -> None:
        """Takes in a frame to learn from.

        Args:
            frame: Made ready.
            again: It was learnt from before a checkpoint, and counts no second time.
        """
        slot = self.replay.add(frame)
        known = self.corrections.get(frame.index)
        self.poses.put(slot, frame.pose, correction=known)
        if known is not None:
            joints = self.poses.pose(slot).joint_rotations
            self.replay.put_cells(slot, WarpCells.of(self.avatar.rig, joints))
            self.replay.move_root(slot, self.poses.root(slot))
        self.frames_seen += not again

    def step(self, *, rate: float, hard_share: float) -> StepResult:
        """Draws rays, follows their gradient once, and keeps the occupancy up to date.

        Args:
            rate: Factor of the learning rates, in (0, 1].
            hard_share: Share of the hard-surface loss's weight, in [0, 1].
        """
        config, field = self.config, self.avatar.field
        batch = self.replay.draw(config.rays, self._generator)
        refines = config.refine_poses and self.steps >= REFINED_AFTER_STEPS
        result = gradients(
            field, self.avatar.occupancy, self.replay.cells, batch, config,
            hard_share=hard_share,
            remember=self.steps % config.occupancy_every < 2,
            poses=self.poses if refines else None,
            generator=self._generator,
        )  # fmt: skip
        for group, base in zip(self.optimizer.param_groups, (1.0, NETWORK_RATE), strict=True):
            group["lr"] = config.learning_rate * base * rate
        self.optimizer.step()
        field.table_grad.zero_()
        if refines:
            self._correct_poses(rate)
        self.replay.learn_errors(batch.rays.slots.long(), result.loss)
        if self.steps % config.occupancy_every == 0:
            self._update_occupancy()
        self.steps += 1
        self.rays += config.rays
        self.samples += result.samples
        return result

    def _correct_poses(self, rate: float) -> None:
        for _ in range(CORRECTIONS_PER_STEP):
            slot = let_follow(self.avatar.rig, self.backend, self.replay, self.poses, rate=rate)
            if slot is not None:
                correction = self.poses.corrections[slot].copy()
                self.corrections[self.replay.indices[slot]] = correction

    def _update_occupancy(self) -> None:
        clearing = self.steps < CLEARING_STEPS
        self.avatar.occupancy.update(
            lambda points: self.avatar.field.raw_at(points)[:, 3],
            share=0.5 if clearing else 0.25,
            decay=FIRST_DECAY if clearing else DECAY,
            drop_specks=not clearing,
            step_m=self.config.step_m,
            generator=self._generator,
        )


def let_follow(
    rig: Rig, backend: Backend, replay: Replay, poses: PoseTable, *, rate: float
) -> int | None:
    """Corrects one pose; its frame's warp and rays follow.

    Args:
        rig: Whose body.
        backend: Moves the warp cells.
        replay: Holds the frames.
        poses: Holds their poses, slot by slot.
        rate: Factor of the step, in (0, 1].

    Returns:
        The slot whose pose moved, or None if too little is known about any.
    """
    slot = poses.correct_one(rate=rate)
    if slot is None:
        return None
    if poses.strayed(slot):
        replay.put_cells(slot, WarpCells.of(rig, poses.pose(slot).joint_rotations))
    else:
        backend.follow(replay.cells, slot, poses.skin, poses.bones[slot])
    replay.move_root(slot, poses.root(slot))
    return slot


@final
class Clock:
    """Training time, wall and CPU, on top of what earlier runs have used."""

    def __init__(self, trainer: Trainer) -> None:
        """Starts now."""
        self._trainer = trainer
        self._wall = time.perf_counter() - trainer.wall_seconds
        self._cpu = time.process_time() - trainer.cpu_seconds

    def read(self) -> float:
        """Wall seconds; the trainer's own counts are set to now."""
        self._trainer.wall_seconds = time.perf_counter() - self._wall
        self._trainer.cpu_seconds = time.process_time() - self._cpu
        return self._trainer.wall_seconds


def train(
    trainer: Trainer, inbox: Inbox[PreparedFrame | HeldOut | Dropped], held: list[HeldOut]
) -> Iterator[TrainEvent]:
    """Trains until the time is up, on whatever has arrived.

    The learning rate is constant while frames arrive and falls as a cosine after the last. No
    frame is lost: where the time is too short to read them all beside training, reading comes
    first, and ends after the time if it must.

    Args:
        trainer: Goes on from where it stands.
        inbox: Frames as they become ready.
        held: Held-out frames; those that arrive are appended.

    Yields:
        What happens, on the caller's thread: what the caller does with an event takes training
        time.
    """
    config, stream, marks = trainer.config, _Stream(trainer, inbox, held), _Marks(trainer)
    while True:
        now = stream.clock.read()
        yield from stream.take_in(urgent=now > READING_SHARE * config.seconds)
        if len(trainer.replay) == 0:
            if stream.ended:
                return
            continue
        now = stream.clock.read()
        if stream.is_done(now):
            break
        if marks.due(now):
            yield marks.score(held, stream.clock)
            continue
        if stream.is_behind(now):
            continue
        yield _stepped(trainer, stream, now)
    yield from _farewell(trainer)


def _stepped(trainer: Trainer, stream: "_Stream", now: float) -> Stepped:
    result = trainer.step(
        rate=cosine(stream.progress(now)), hard_share=min(1.0, 4.0 * now / trainer.config.seconds)
    )
    return Stepped(
        step=trainer.steps,
        wall_seconds=stream.clock.read(),
        loss=float(result.loss.mean()),
        samples_per_ray=result.samples / trainer.config.rays,
        frames_seen=trainer.frames_seen,
    )


def _farewell(trainer: Trainer) -> Iterator[Warned | Finished]:
    config = trainer.config
    if trainer.wall_seconds > 1.1 * config.seconds and not config.steps:
        yield Warned(
            message=f"Reading the video took longer than the {config.seconds:.0f} s that were "
            f"given: training ended after {trainer.wall_seconds:.0f} s, when every frame had been "
            "learnt from. Give more --seconds, or fewer --frames"
        )
    yield Finished(
        wall_seconds=trainer.wall_seconds,
        cpu_seconds=trainer.cpu_seconds,
        steps=trainer.steps,
        rays=trainer.rays,
        samples=trainer.samples,
    )


@final
class _Stream:
    """What arrives while training goes on, and since when nothing more does."""

    def __init__(
        self,
        trainer: Trainer,
        inbox: Inbox[PreparedFrame | HeldOut | Dropped],
        held: list[HeldOut],
    ) -> None:
        self._trainer, self._inbox, self._held = trainer, inbox, held
        self._ended_at: float | None = None
        self._last_steps = 0
        self.clock = Clock(trainer)
        self._started = len(trainer.replay) > 0  # a resumed run remembers frames

    @property
    def ended(self) -> bool:
        """Whether nothing more will arrive."""
        return self._ended_at is not None

    def take_in(self, *, urgent: bool) -> Iterator[Warned]:
        """Hands what has arrived to the trainer; the clock starts with the first frame.

        Args:
            urgent: Wait a little for something to arrive, so that the reader has the machine.
        """
        if self.ended:
            return
        wait_s = 0.1 if urgent or len(self._trainer.replay) == 0 else 0.0
        for item in self._inbox.take(wait_s=wait_s):
            if isinstance(item, Dropped):
                yield Warned(message=f"Frame {item.index} is left out: {item.reason}.")
                continue
            if not self._started:
                self.clock, self._started = Clock(self._trainer), True
            if isinstance(item, HeldOut):
                self._held.append(item)
            else:
                self._trainer.add(item)
        if self._inbox.finished:
            self._ended_at = self.clock.read()
            self._last_steps = self._trainer.steps + FAREWELL_STEPS

    def is_behind(self, now: float) -> bool:
        """Whether reading must come first for a while."""
        return not self.ended and now > READING_SHARE * self._trainer.config.seconds

    def is_done(self, now: float) -> bool:
        """Whether the time, or the number of steps asked for, is up and nothing is left over."""
        config, steps = self._trainer.config, self._trainer.steps
        if config.steps and steps >= config.steps:
            return True
        return now >= config.seconds and self.ended and steps >= self._last_steps

    def progress(self, now: float) -> float:
        """How much of the time after the last frame has gone by, in [0, 1]; 0 before it."""
        if self._ended_at is None:
            return 0.0
        tail = self._trainer.config.seconds - self._ended_at
        return (now - self._ended_at) / max(tail, 1e-6)


@final
class _Marks:
    """When the curve is measured, and how long that may take."""

    def __init__(self, trainer: Trainer) -> None:
        self._trainer = trainer
        self._times = _mark_times(after=trainer.wall_seconds)
        self._next = next(self._times)

    def due(self, now: float) -> bool:
        """Whether a mark has been reached."""
        return now >= self._next

    def score(self, held: list[HeldOut], clock: Clock) -> Evaluated:
        """Scores held-out frames, evenly over the stream, until the time for it is spent."""
        trainer, scores = self._trainer, list[Score]()
        at, cpu_at = trainer.wall_seconds, trainer.cpu_seconds
        enough = at + SCORING_SHARE * trainer.config.seconds
        for frame in interleaved(spread(held, SCORED_AT_A_MARK)):
            if scores and clock.read() > enough:
                break
            scores.append(score(trainer.avatar, frame))
        now = clock.read()
        self._next = next(time for time in self._times if time > now)
        return Evaluated(
            wall_seconds=at,
            cpu_seconds=cpu_at,
            frames_seen=trainer.frames_seen,
            scores=tuple(scores),
        )


def _mark_times(*, after: float) -> Iterator[float]:
    for mark in MARKS_S:
        if mark > after:
            yield mark
    mark = MARKS_S[-1] + 30.0
    while True:
        if mark > after:
            yield mark
        mark += 30.0

"""The trainer: everything that training changes, and one step of it."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import final

import numpy as np
import torch
from jaxtyping import Float

from avatar.adam import Adam
from avatar.average import follow
from avatar.cells import WarpCells
from avatar.config import COARSEST_M, NOMINAL_STEPS_PER_S, TrainConfig
from avatar.field import Field
from avatar.kernels.backend import Backend
from avatar.kernels.choice import backend_for
from avatar.levels import HashLevels
from avatar.model import Avatar
from avatar.occupancy import DECAY, FIRST_DECAY, Occupancy
from avatar.paper.variants import sampler_for
from avatar.prepare import PreparedFrame
from avatar.refine import PoseTable
from avatar.replay import Replay
from avatar.rig import Rig
from avatar.step import StepResult, gradients

NETWORK_RATE = 0.3
"""The network's learning rate as a share of the table's."""
CLEARING_STEPS = 300
"""Steps during which the first fog clears: the occupancy is probed more and forgets faster."""
CORRECTIONS_PER_STEP = 2


@final
class Trainer:
    """Everything that training changes, and one step of it.

    Attributes:
        avatar: As it stands and is shown; its field is the running mean of `field`.
        field: What steps change.
        config: The recipe.
        sampler: Where samples lie along rays.
        replay: The frames it learns from.
        poses: Their poses, corrected if the recipe says so.
        corrections: How each frame's pose was corrected, by the frame's number in its source; a
            frame that comes again starts from there. Clear it before another source is read. At
            most twice as many are kept as frames in replay.
        steps, rays, samples: How much has been done.
        wall_seconds, cpu_seconds: Training time so far; a resumed run goes on counting.
        frames_seen: Frames taken in so far, whether or not they are still kept.
        stepping_wall, stepping_cpu: Seconds inside steps of this process, by the wall clock and of
            CPU time.
        held_up_wall, held_up_cpu: Seconds for which somebody held training up (`held_up`).
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
        self.field = Field(levels, self.backend, device, start)
        learner = Avatar(
            rig=rig, field=self.field, occupancy=Occupancy(rig, device), step_m=config.step_m
        )
        self.sampler = sampler_for(config, learner)
        self.avatar = replace(learner, field=self.field.copied())
        self.replay = Replay(config.key_frames, device)
        self.poses = PoseTable(rig, config.key_frames, device)
        self.corrections: dict[int, Float[np.ndarray, "25 3"]] = {}
        self.steps = self.rays = self.samples = self.frames_seen = 0
        self.wall_seconds = self.cpu_seconds = 0.0
        self.stepping_wall = self.stepping_cpu = 0.0
        self.held_up_wall = self.held_up_cpu = 0.0
        self._generator = torch.Generator(device=device).manual_seed(config.seed)
        rate = config.learning_rate
        self.optimizer = Adam(
            [
                {"params": [self.field.table], "lr": rate, "eps": 1e-15},
                {"params": self.field.layers, "lr": rate * NETWORK_RATE},
            ],
            betas=(0.9, 0.99),
            fused=True,
        )

    @property
    def scheduled_seconds(self) -> float:
        """Position in the schedule: wall seconds, or steps at their nominal rate."""
        if self.config.steps:
            return self.steps / NOMINAL_STEPS_PER_S
        return self.wall_seconds

    def add(self, frame: PreparedFrame, *, again: bool = False) -> None:
        """Takes in a frame to learn from.

        Args:
            frame: Made ready.
            again: It was learnt from before a checkpoint, and counts no second time.
        """
        slot = self.replay.add(frame)
        known = self.corrections.get(frame.index)
        step = 0 if again else self.steps
        self.poses.put(slot, frame.pose, correction=known, frame=frame.index, step=step)
        if known is not None:
            rebuild_warp(self.avatar.rig, self.replay, self.poses, slot)
        self.sampler.admit(slot, self.replay.cells, self.poses.bones[slot])
        self.frames_seen += not again
        if not again:
            self._forget_corrections()

    @contextmanager
    def held_up(self) -> Iterator[None]:
        """Time that passes in this block does not count as training."""
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            yield
        finally:
            self.held_up_wall += time.perf_counter() - wall
            self.held_up_cpu += time.process_time() - cpu

    def step(self, *, rate: float, hard_share: float, pose_rate: float | None = None) -> StepResult:
        """Draws rays, follows their gradient once, and keeps the occupancy up to date.

        Args:
            rate: Factor of the learning rates, in (0, 1].
            hard_share: Share of the hard-surface loss's weight, in [0, 1].
            pose_rate: Factor of the corrections of poses, in (0, 1]; `rate` if None. As it falls,
                surfaces become firm.
        """
        config, field = self.config, self.field
        falling = rate if pose_rate is None else pose_rate
        batch = self.replay.draw(config.rays, self._generator)
        remembers = self.steps % config.occupancy_every < 2
        refines = config.refine_poses and self.steps % self.poses.every == 0
        refines = refines and self.poses.settle(self.steps)
        result = gradients(
            field, self.sampler, self.replay.cells, batch, config,
            hard_share=hard_share,
            firm_share=1.0 - falling,
            remember=self.avatar.occupancy.grid if remembers else None,
            poses=self.poses if refines else None,
            generator=self._generator,
        )  # fmt: skip
        for group, base in zip(self.optimizer.param_groups, (1.0, NETWORK_RATE), strict=True):
            group["lr"] = config.learning_rate * base * rate
        self.optimizer.step()
        field.table_grad.zero_()
        if refines:
            self._correct_poses(falling)
        self.replay.learn_errors(batch.rays.slots.long(), result.loss)
        if self.steps % config.occupancy_every == 0:
            self._update_occupancy(1.0 - falling)
        self.sampler.update(self.steps, self.replay.cells, self._generator)
        self.steps += 1
        follow(self.avatar.field, field, self.steps)
        self.rays += config.rays
        self.samples += result.samples
        return result

    def _forget_corrections(self) -> None:
        """Of frames that are long gone from replay, so that memory stays bounded."""
        if len(self.corrections) > 2 * self.replay.capacity:
            kept = set(self.replay.indices)
            self.corrections = {i: c for i, c in self.corrections.items() if i in kept}

    def _correct_poses(self, rate: float) -> None:
        for _ in range(CORRECTIONS_PER_STEP):
            slot = let_follow(self.avatar.rig, self.backend, self.replay, self.poses, rate=rate)
            if slot is not None:
                correction = self.poses.corrections[slot].copy()
                self.corrections[self.replay.indices[slot]] = correction

    def _update_occupancy(self, firm_share: float) -> None:
        clearing = self.steps < CLEARING_STEPS
        self.avatar.occupancy.update(
            lambda points: self.field.raw_at(points)[:, 3],
            share=0.5 if clearing else 0.25,
            decay=FIRST_DECAY if clearing else DECAY,
            thinnest=self.config.thin_density * firm_share,
            drop_specks=not clearing,
            step_m=self.config.step_m,
            generator=self._generator,
        )


def rebuild_warp(rig: Rig, replay: Replay, poses: PoseTable, slot: int) -> None:
    """Solves a frame's warp cells again and moves its rays to its corrected pose."""
    joints = poses.pose(slot).joint_rotations
    replay.put_cells(slot, WarpCells.of(rig, joints, device=replay.device))
    replay.move_root(slot, poses.root(slot))


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
        rebuild_warp(rig, replay, poses, slot)
    else:
        backend.follow(replay.cells, slot, poses.skin, poses.bones[slot])
        replay.move_root(slot, poses.root(slot))
    return slot

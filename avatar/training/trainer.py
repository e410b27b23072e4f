"""The trainer: the state that training changes, one training step, and the rendered mean.

At a high learning rate the parameters oscillate about an optimum that their mean stays close to
(Polyak and Juditsky 1992). On the sample the mean gains 1.0 to 1.5 dB at any time before the rate
falls, which is the whole time while a video streams, and costs nothing afterwards.
"""

import inspect
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Float, Float32

from avatar.avatar_model import Avatar, OrientationShading
from avatar.config import COARSEST_M, NOMINAL_STEPS_PER_S, TrainConfig
from avatar.correspondence_grid import CorrespondenceGrid
from avatar.kernels import operations
from avatar.kernels.operands import AdamArrays, AdamSettings, HashLevels
from avatar.occupancy_grid import INITIAL_OCCUPANCY_DECAY, OCCUPANCY_DECAY, OccupancyGrid
from avatar.radiance_field import RadianceField
from avatar.rig import Rig
from avatar.training.frame_exposure import FrameExposures
from avatar.training.frame_stream import TrainingFrame
from avatar.training.pose_optimizer import PoseOptimizer
from avatar.training.replay_buffer import ReplayBuffer
from avatar.training.training_step import StepResult, compute_gradients
from avatar.training.unseen_skin import UnseenSkin

EMA_HORIZON_STEPS = 250
"""Steps that the mean averages over; a longer horizon shows new content later."""
EMA_INTERVAL = 16
"""Steps between updates of the mean."""


def cosine_decay(progress: float) -> float:
    """The learning rate's factor: 1 at progress 0, 0.05 at 1."""
    return max(0.05, 0.5 * (1.0 + math.cos(math.pi * min(max(progress, 0.0), 1.0))))


def update_ema(average: RadianceField, field: RadianceField, steps: int) -> None:
    """Updates the exponential mean of a field, in place, every `EMA_INTERVAL` steps."""
    if steps % EMA_INTERVAL and steps > EMA_INTERVAL:
        return
    # the first steps were fog
    share = min(1.0, EMA_INTERVAL / min(EMA_HORIZON_STEPS, max(steps * 0.2, 1.0)))
    operations.move_toward(average.parameters(), field.parameters(), share)


@final
class UncompiledAdam(torch.optim.Adam):
    """`torch.optim.Adam` that does not load `torch._dynamo` (0.7 to 1 s) at its first use.

    torch wraps these methods to exclude them from compilation, and loads the compiler to do so.
    Nothing is compiled here, and the unwrapped methods are used. `memory` is `step_optimizer`'s.
    """

    add_param_group = inspect.unwrap(torch.optim.Adam.add_param_group)
    state_dict = inspect.unwrap(torch.optim.Adam.state_dict)
    step = torch.no_grad()(inspect.unwrap(torch.optim.Adam.step))

    def __init__(self, params: Any, **options: Any) -> None:
        """Starts with the arguments of `torch.optim.Adam`."""
        super().__init__(params, **options)
        self.memory = dict[torch.nn.Parameter, tuple[Float32[np.ndarray, ""], AdamArrays]]()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continues from a saved state."""
        inspect.unwrap(torch.optim.Adam.load_state_dict)(self, state_dict)
        self.memory.clear()


def step_optimizer(optimizer: UncompiledAdam) -> None:
    """Takes the optimizer's step by our kernel, and zeroes the gradients.

    The state is that of `torch.optim.Adam`, whose own kernel takes 1.5 times as long. Its memory is
    looked up once, since that takes longer than a step of the small parameters.
    """
    stepped = []
    for group in optimizer.param_groups:
        for parameter in group["params"]:
            if parameter not in optimizer.memory:
                optimizer.memory[parameter] = _memory_of(optimizer, parameter)
            steps, arrays = optimizer.memory[parameter]
            steps += 1
            how = AdamSettings(group["lr"], group["betas"], group["eps"], int(steps))
            stepped.append((how, arrays))
    operations.adam_step(stepped)


def _memory_of(
    optimizer: UncompiledAdam, parameter: torch.nn.Parameter
) -> tuple[Float32[np.ndarray, ""], AdamArrays]:
    """Steps and arrays of a parameter, whose state begins if there is none."""
    state, grad = optimizer.state[parameter], parameter.grad
    if not state:
        state["step"] = torch.zeros(())
        state["exp_avg"] = torch.zeros_like(parameter)
        state["exp_avg_sq"] = torch.zeros_like(parameter)
    assert grad is not None, "a gradient is zeroed, never taken away"
    parts = grad, state["exp_avg"], state["exp_avg_sq"], parameter.detach()
    arrays = AdamArrays(*(part.numpy().reshape(-1) for part in parts))
    return state["step"].numpy(), arrays


NETWORK_RATE_FACTOR = 0.3
"""The network's learning rate as a share of the table's."""


@final
class Trainer:
    """The state that training changes, and one training step.

    Attributes:
        field: The field that steps change.
        learner: Avatar with `field`.
        avatar: Avatar to render; its field is the running mean of `field`.
        poses, exposures: Of the replay frames, corrected if the configuration says so.
        unseen: The skin that frames have shown, and the sources of the other skin.
        pose_corrections: Correction of each frame's pose, by the frame's index in its source; a
            frame that is read again starts from it. To be cleared before another source is read;
            keeps at most twice the replay capacity.
        wall_seconds, cpu_seconds: Training time so far, continued by a resumed run.
        frames_seen: Frames added so far, whether or not the replay buffer still holds them.
        step_cpu_seconds: CPU time of this process inside steps.
        paused_wall_seconds, paused_cpu_seconds: Time inside `paused`.
    """

    def __init__(self, rig: Rig, config: TrainConfig) -> None:
        """Starts without frames, from random parameters."""
        self.config = config
        levels = HashLevels.spanning(
            rig.box_low, rig.box_high, coarsest_m=COARSEST_M, finest_m=config.finest_m,
            levels=config.levels, table_size=config.table_size,
        )  # fmt: skip
        start = torch.Generator().manual_seed(config.seed)
        self.field = RadianceField(levels, start)
        self.learner = Avatar(
            rig=rig,
            field=self.field,
            occupancy=OccupancyGrid(rig),
            sample_step_m=config.sample_step_m,
            shading=OrientationShading(rig),
        )
        self.unseen = UnseenSkin(rig)
        self.avatar = replace(self.learner, field=self.field.clone())
        self.replay = ReplayBuffer(config.replay_capacity)
        self.poses = PoseOptimizer(
            rig, config.replay_capacity, poses_may_be_exact=config.poses_may_be_exact
        )
        self.exposures = FrameExposures(config.replay_capacity)
        self.pose_corrections: dict[int, Float[np.ndarray, "25 3"]] = {}
        self.steps = self.rays = self.samples = self.frames_seen = 0
        self.wall_seconds = self.cpu_seconds = 0.0
        self.step_cpu_seconds = 0.0
        self.paused_wall_seconds = self.paused_cpu_seconds = 0.0
        self.generator = torch.Generator().manual_seed(config.seed)
        rate = config.learning_rate
        self.optimizer = UncompiledAdam(
            [
                {"params": [self.field.table], "lr": rate, "eps": 1e-15},
                {"params": self.field.layers, "lr": rate * NETWORK_RATE_FACTOR},
            ],
            betas=(0.9, 0.99),
        )

    @property
    def scheduled_seconds(self) -> float:
        """Position in the schedule, seconds: wall time, or steps at their nominal rate."""
        if self.config.steps:
            return self.steps / NOMINAL_STEPS_PER_S
        return self.wall_seconds

    def add_frame(self, frame: TrainingFrame, *, is_restored: bool = False) -> int:
        """Adds a frame to the replay buffer and its pose to the optimizer; returns its slot.

        A restored frame was trained on before a checkpoint, and is not counted again.
        """
        slot = self.replay.add(frame)
        self.unseen.add(frame)
        self.exposures.set_frame(slot, frame.index)
        known = self.pose_corrections.get(frame.index)
        step = 0 if is_restored else self.steps
        self.poses.set_pose(slot, frame.pose, correction=known, frame=frame.index, step=step)
        if known is not None:
            resolve_correspondences(self.replay, self.poses, slot)
        self.frames_seen += not is_restored
        if not is_restored:
            self._discard_old_corrections()
        return slot

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Excludes the time spent in this block from the training time."""
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            yield
        finally:
            self.paused_wall_seconds += time.perf_counter() - wall
            self.paused_cpu_seconds += time.process_time() - cpu

    def step(
        self,
        *,
        rate: float,
        hard_surface_share: float,
        pose_rate: float | None = None,
        detail_share: float = 1.0,
    ) -> StepResult:
        """Makes one gradient step on a batch of rays, and updates poses, occupancy and mean.

        Args:
            rate: Factor of the learning rates, in (0, 1].
            hard_surface_share: Share of the hard-surface loss's weight, in [0, 1].
            pose_rate: Factor of the pose corrections, in (0, 1]; `rate` if None. Surfaces are made
                firm as it falls.
            detail_share: Progress from coarse samples along rays to fine ones, in [0, 1].
        """
        config, field = self._config_at(detail_share), self.field
        if self.steps % 64 == 0:
            has_new_frames = self.unseen.update()
            if has_new_frames and config.head_interior_weight:
                face = self.unseen.face_cells(config.pose_uncertainty)
                self.learner.occupancy.shape_face(face.before, face.under)
        falling = rate if pose_rate is None else pose_rate
        batch = self.replay.sample_rays(config.rays, self.generator)
        refines = config.refine_poses and self.steps % self.poses.correction_interval(falling) == 0
        refines = refines and self.poses.freeze_converged(self.steps)
        neutral = self.exposures.neutralize(batch)
        result = compute_gradients(
            self.learner, self.replay.correspondences, neutral, config,
            hard_surface_share=hard_surface_share,
            surface_share=1.0 - falling,
            caches_density=self.steps % config.occupancy_interval < 2,
            unseen=self.unseen,
            poses=self.poses if refines else None,
            generator=self.generator,
        )  # fmt: skip
        for group, base in zip(
            self.optimizer.param_groups, (1.0, NETWORK_RATE_FACTOR), strict=True
        ):
            group["lr"] = config.learning_rate * base * rate
        step_optimizer(self.optimizer)
        if refines:
            self._correct_poses(falling)
        if config.estimate_exposures:
            self.exposures.observe(batch, result.rendered)
        if config.estimate_shading:
            self.learner.shading.observe(result.normals, neutral.target, result.rendered)
        if self.steps % config.occupancy_interval == 0:
            self._update_occupancy(1.0 - falling)
        self.steps += 1
        update_ema(self.avatar.field, field, self.steps)
        self.rays += config.rays
        self.samples += result.sample_count
        return result

    def _config_at(self, detail_share: float) -> TrainConfig:
        """The configuration with the samples' distance of this step."""
        step_m = self.config.sample_step_at(detail_share)
        if step_m == self.config.sample_step_m:
            return self.config
        return replace(self.config, sample_step_m=step_m)

    def _discard_old_corrections(self) -> None:
        """Drops corrections of frames that replay no longer holds, to bound the memory."""
        if len(self.pose_corrections) > 2 * self.replay.capacity:
            kept = set(self.replay.frame_indices)
            self.pose_corrections = {i: c for i, c in self.pose_corrections.items() if i in kept}

    def _correct_poses(self, rate: float) -> None:
        for slot in correct_poses(self.replay, self.poses, 2, rate=rate):
            correction = self.poses.corrections[slot].copy()
            self.pose_corrections[self.replay.frame_indices[slot]] = correction

    def _update_occupancy(self, surface_share: float) -> None:
        clearing = self.steps < 300
        self.avatar.occupancy.update(
            lambda points: self.field.raw_outputs_at(points)[:, 3],
            share=0.5 if clearing else 0.25,
            decay=INITIAL_OCCUPANCY_DECAY if clearing else OCCUPANCY_DECAY,
            min_density=self.config.min_occupied_density * surface_share,
            drop_floaters=not clearing,
            sample_step_m=self.config.sample_step_m,
            generator=self.generator,
        )


def resolve_correspondences(replay: ReplayBuffer, poses: PoseOptimizer, slot: int) -> None:
    """Solves a frame's correspondence grid again and moves its rays to its corrected pose."""
    joints = poses.pose(slot).joint_rotations
    replay.set_correspondences(slot, CorrespondenceGrid.solve(poses.rig, joints))
    replay.correct_root(slot, poses.root_correction(slot))


def correct_poses(
    replay: ReplayBuffer, poses: PoseOptimizer, most: int, *, rate: float
) -> list[int]:
    """Corrects poses by a step times `rate`; correspondences and rays of their frames follow.

    Returns the slots that move, of the `most` with the most rays: none if no pose has enough.
    """
    # no slot comes twice: its rays are counted from 0 again
    tried = [poses.correct_next(rate=rate) for _ in range(most)]
    moved = [slot for slot in tried if slot is not None]
    near = [slot for slot in moved if not poses.needs_resolve(slot)]
    if near:
        operations.update_roots(replay.correspondences, near, poses.skinning, poses.bones)
    for slot in moved:
        if slot in near:
            replay.correct_root(slot, poses.root_correction(slot))
        else:
            resolve_correspondences(replay, poses, slot)
    return moved

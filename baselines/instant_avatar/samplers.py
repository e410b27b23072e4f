"""The baselines' samplers, and the training step that keeps their grids up to date.

The paper skips empty space in the body frame and finds the canonical root of each sample that is
left; the field is queried at all of them.
"""

from dataclasses import dataclass
from typing import Literal, final

import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.avatar_model import Avatar
from avatar.config import TrainConfig
from avatar.kernels.operands import (
    CorrespondenceTables,
    DensityGrid,
    RayBatch,
    RaySamples,
)
from avatar.rig import Rig
from avatar.training.frame_stream import TrainingFrame
from avatar.training.trainer import Trainer
from avatar.training.training_step import OccupancySampler, RaySampler, StepResult
from avatar.training.unseen_skin import SourcePairs
from baselines.instant_avatar.occupied_samples import sample_occupied_cells
from baselines.instant_avatar.posed_field import (
    BroydenWarp,
    CanonicalWarp,
    CorrespondenceWarp,
    PosedField,
)
from baselines.instant_avatar.posed_occupancy import (
    CorrespondenceBand,
    NoSkipping,
    PerFrameGrids,
    PosedEmptySpace,
    SequenceGrid,
)


@final
class PosedSampler:
    """Samples the occupied cells of the body frame and warps each sample on its own.

    A ray does not end at a surface: its samples reach to the far wall of the person's box.
    """

    def __init__(self, emptiness: PosedEmptySpace, warp: CanonicalWarp, step_m: float) -> None:
        """Combines a body-frame occupancy with a warp.

        Args:
            emptiness: Occupancy in the body frame.
            warp: Carries samples to canonical space.
            step_m: Distance between samples along a ray, metres.
        """
        self._emptiness = emptiness
        self._warp, self._step_m = warp, step_m

    def sample_rays(self, rays: RayBatch, correspondences: CorrespondenceTables) -> RaySamples:
        """Canonical samples along rays; a sample without a canonical point is left out."""
        points, placed = sample_occupied_cells(
            rays, self._emptiness.posed_occupancy(correspondences), self._step_m
        )
        slots = rays.slots.repeat_interleave(placed)
        warped = self._warp(points, slots, correspondences)
        before = torch.nn.functional.pad(torch.cumsum(warped.has_root.int(), 0), (1, 0))
        last = torch.cumsum(placed, 0)
        first = before[last - placed]
        count = before[last] - first
        return RaySamples(warped.points, first, count.int(), warped.root_rows)

    def sample_empty(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Canonical points in cells that are known to be empty, at most `count`."""
        return self._emptiness.sample_empty(count, generator)

    def sample_source_pairs(self, count: int, generator: torch.Generator) -> SourcePairs:
        """None: the paper leaves unseen skin to chance."""
        return SourcePairs.none()

    def add_frame(
        self, slot: int, correspondences: CorrespondenceTables, bones: Float32[Tensor, "24 12"]
    ) -> None:
        """Registers the frame that a slot holds from now on.

        Args:
            slot: Slot of the frame.
            correspondences: Correspondence grids of all slots.
            bones: Transforms from the canonical to the body frame in the frame's pose.
        """
        self._warp.set_pose(slot, bones)
        self._emptiness.add_frame(slot, correspondences)

    def update(
        self, steps: int, correspondences: CorrespondenceTables, generator: torch.Generator
    ) -> None:
        """Renews the grids, if it is time.

        Args:
            steps: Steps before the one that has just been made.
            correspondences: Correspondence grids of all slots.
            generator: Source of random numbers.
        """
        self._emptiness.update(steps, correspondences, generator)


@final
class GlobalSparsitySampler:
    """Samples rays as another sampler does, and penalises density in the whole box.

    This is the prior that the paper's Fig. 5 compares with: it biases the density of every point
    towards zero, the person's own included.
    """

    def __init__(
        self, sampler: RaySampler, low: Float32[Tensor, "3"], high: Float32[Tensor, "3"]
    ) -> None:
        """Penalises density anywhere between two corners of a box, metres."""
        self._sampler, self._low, self._high = sampler, low, high

    def sample_rays(self, rays: RayBatch, correspondences: CorrespondenceTables) -> RaySamples:
        """Samples of the other sampler."""
        return self._sampler.sample_rays(rays, correspondences)

    def sample_empty(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Random points of the whole box."""
        place = torch.rand(count, 3, generator=generator)
        return self._low + place * (self._high - self._low)

    def sample_source_pairs(self, count: int, generator: torch.Generator) -> SourcePairs:
        """Pairs of the other sampler."""
        return self._sampler.sample_source_pairs(count, generator)


@dataclass(frozen=True, kw_only=True)
class BaselineScheme:
    """How empty space is skipped, how canonical roots are found, and where density is penalised."""

    skipping: Literal["canonical", "union", "frame", "none"] = "canonical"
    """Occupancy: ours in canonical space, the paper's in the body frame (one grid for the sequence
    or one for each frame, §3.3), or none."""
    roots: Literal["cells", "broyden"] = "cells"
    """Root finding: our correspondence grid, or Broyden's method for each sample (Fast-SNARF)."""
    empty_term: Literal["occupancy", "global"] = "occupancy"
    """Density penalty: in empty cells (§3.4), or in the whole box."""

    def check(self, config: TrainConfig) -> None:
        """Refuses a combination that cannot be trained.

        Raises:
            ValueError: If the scheme and the configuration contradict each other.
        """
        if self.roots == "broyden" and config.refine_poses:
            raise ValueError(
                "roots='broyden' warps samples without the correspondence grid, which carries a "
                "pose's gradient: set refine_poses=False."
            )
        if self.skipping == "none" and self.empty_term == "occupancy" and config.empty_space_weight:
            raise ValueError(
                "skipping='none' has no empty cells whose density could be penalised: set "
                "empty_space_weight=0 or empty_term='global'."
            )

    def posed_sampler(self, avatar: Avatar, config: TrainConfig) -> PosedSampler | None:
        """The scheme's body-frame sampler; None where it samples canonical occupancy, as ours."""
        if self.skipping == "canonical" and self.roots == "cells":
            return None
        grid = avatar.occupancy.density_grid if self.skipping == "canonical" else None
        warp = self.warp(avatar, config.replay_capacity, kept_in=grid)
        field = PosedField(avatar.field, warp)
        emptiness: PosedEmptySpace
        match self.skipping:
            case "union":
                emptiness = SequenceGrid(avatar.rig, field, interval=config.occupancy_interval)
            case "frame":
                emptiness = PerFrameGrids(field, config.replay_capacity)
            case "none":
                emptiness = NoSkipping()
            case "canonical":
                emptiness = CorrespondenceBand(avatar.occupancy)
        return PosedSampler(emptiness, warp, config.sample_step_m)

    def warp(self, avatar: Avatar, slots: int, *, kept_in: DensityGrid | None) -> CanonicalWarp:
        """The scheme's warp for a number of slots.

        Args:
            avatar: Avatar whose samples are warped.
            slots: Number of poses that the warp can hold.
            kept_in: Occupancy outside which Broyden's roots are dropped; None to keep them all.
        """
        if self.roots == "broyden":
            return BroydenWarp(avatar.field, avatar.rig, slots, kept_in=kept_in)
        return CorrespondenceWarp(avatar.occupancy)


@final
class BaselineTrainer:
    """Trains an avatar with a baseline's scheme.

    Attributes:
        trainer: The trainer, whose sampler is the scheme's.
    """

    def __init__(self, rig: Rig, config: TrainConfig, scheme: BaselineScheme) -> None:
        """Starts without frames.

        Raises:
            ValueError: If the scheme and the configuration contradict each other.
        """
        scheme.check(config)
        self.trainer = trainer = Trainer(rig, config)
        self._posed_sampler = scheme.posed_sampler(trainer.learner, config)
        trainer.sampler = self._posed_sampler or OccupancySampler(trainer.learner.occupancy, config)
        if scheme.empty_term == "global":
            low, high = map(torch.from_numpy, (rig.box_low, rig.box_high))
            trainer.sampler = GlobalSparsitySampler(trainer.sampler, low, high)

    def add_frame(self, frame: TrainingFrame) -> None:
        """Adds a frame to train on."""
        trainer = self.trainer
        slot = trainer.add_frame(frame)
        if self._posed_sampler is not None:
            bones = trainer.poses.bones[slot]
            self._posed_sampler.add_frame(slot, trainer.replay.correspondences, bones)

    def step(self, *, rate: float, hard_surface_share: float) -> StepResult:
        """Makes one training step, then renews the scheme's grids (`Trainer.step`)."""
        trainer = self.trainer
        result = trainer.step(rate=rate, hard_surface_share=hard_surface_share)
        if self._posed_sampler is not None:
            self._posed_sampler.update(
                trainer.steps - 1, trainer.replay.correspondences, trainer.generator
            )
        return result

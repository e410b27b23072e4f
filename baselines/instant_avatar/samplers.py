"""The paper's order of things: skip in the body frame, warp what is left, ask all of it.

Which sampler a recipe asks for, in training and in rendering.
"""

from collections.abc import Callable
from typing import final

import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.config import RootScheme, SkippingScheme, TrainConfig
from avatar.deformation.correspondence_grid import CorrespondenceGrid
from avatar.field.avatar_model import Avatar
from avatar.kernels.backend_protocol import (
    Backend,
    CorrespondenceTables,
    DensityGrid,
    RayBatch,
    RaySamples,
)
from avatar.render import correspondence_tables
from avatar.training.training_step import OccupancySampler, RaySampler
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
from preprocess.body.body_pose import BodyPose


@final
class PosedSampler:
    """Samples of the body frame that are not known to be empty, each warped on its own.

    No ray ends early: every sample up to the far wall of the person's box is there.
    """

    def __init__(
        self, backend: Backend, emptiness: PosedEmptySpace, warp: CanonicalWarp, step_m: float
    ) -> None:
        """A sampler.

        Args:
            backend: Places samples.
            emptiness: Where none need be.
            warp: Carries them to canonical space.
            step_m: Distance between samples along a ray, metres.
        """
        self._backend, self._emptiness = backend, emptiness
        self._warp, self._step_m = warp, step_m

    def sample_rays(self, rays: RayBatch, cells: CorrespondenceTables) -> RaySamples:
        """Canonical samples along rays; what has no canonical point is left out."""
        points, placed = self._backend.sample_occupied_cells(
            rays, self._emptiness.posed_occupancy(cells), self._step_m
        )
        slots = rays.slots.repeat_interleave(placed)
        warped = self._warp(points, slots, cells)
        before = torch.nn.functional.pad(torch.cumsum(warped.has_root.int(), 0), (1, 0))
        last = torch.cumsum(placed, 0)
        first = before[last - placed]
        count = before[last] - first
        return RaySamples(warped.points, first, count.int(), warped.root_rows)

    def sample_empty(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """What is known to be empty."""
        return self._emptiness.sample_empty(count, generator)

    def sample_interior(
        self, count: int, generator: torch.Generator
    ) -> Float32[Tensor, "points 3"]:
        """None: the paper asks nothing of them."""
        return torch.zeros(0, 3, device=generator.device)

    def sample_inner_leg(
        self, count: int, generator: torch.Generator
    ) -> Float32[Tensor, "points 3"]:
        """None, likewise."""
        return torch.zeros(0, 3, device=generator.device)

    def add_frame(
        self, slot: int, cells: CorrespondenceTables, bones: Float32[Tensor, "24 12"]
    ) -> None:
        """Both parts learn of the frame."""
        self._warp.set_pose(slot, bones)
        self._emptiness.add_frame(slot, cells)

    def update(self, steps: int, cells: CorrespondenceTables, generator: torch.Generator) -> None:
        """Grids are renewed when it is time."""
        self._emptiness.update(steps, cells, generator)


@final
class GlobalSparsitySampler:
    """Another sampler, but emptiness is asked for everywhere: the paper's Global Sparsity.

    The prior that the paper's Fig. 5 compares with: it biases the density of every point towards
    zero, the person's own included.
    """

    def __init__(
        self, sampler: RaySampler, low: Float32[Tensor, "3"], high: Float32[Tensor, "3"]
    ) -> None:
        """Asks for emptiness anywhere in the box between two corners."""
        self._sampler, self._low, self._high = sampler, low, high

    def sample_rays(self, rays: RayBatch, cells: CorrespondenceTables) -> RaySamples:
        """The other's."""
        return self._sampler.sample_rays(rays, cells)

    def sample_empty(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Random points of the whole box."""
        place = torch.rand(count, 3, generator=generator, device=generator.device)
        return self._low + place.to(self._low.device) * (self._high - self._low)

    def sample_interior(
        self, count: int, generator: torch.Generator
    ) -> Float32[Tensor, "points 3"]:
        """The other's."""
        return self._sampler.sample_interior(count, generator)

    def sample_inner_leg(
        self, count: int, generator: torch.Generator
    ) -> Float32[Tensor, "points 3"]:
        """The other's."""
        return self._sampler.sample_inner_leg(count, generator)

    def add_frame(
        self, slot: int, cells: CorrespondenceTables, bones: Float32[Tensor, "24 12"]
    ) -> None:
        """The other learns of it."""
        self._sampler.add_frame(slot, cells, bones)

    def update(self, steps: int, cells: CorrespondenceTables, generator: torch.Generator) -> None:
        """The other is renewed."""
        self._sampler.update(steps, cells, generator)


PROBES_PER_RENDERED_POSE = 5
"""Probes of each cell when a pose is rendered, as in the released code."""


def sampler_for(config: TrainConfig, avatar: Avatar) -> RaySampler:
    """The sampler that a recipe asks for."""
    sampler: RaySampler
    if config.skipping == "canonical" and config.roots == "cells":
        sampler = OccupancySampler(avatar.field.backend, avatar.occupancy, config)
    else:
        sampler = _posed_sampler(config, avatar)
    if config.empty_term == "occupancy":
        return sampler
    low, high = (torch.from_numpy(corner) for corner in (avatar.rig.box_low, avatar.rig.box_high))
    device = avatar.field.table.device
    return GlobalSparsitySampler(sampler, low.to(device), high.to(device))


def _posed_sampler(config: TrainConfig, avatar: Avatar) -> PosedSampler:
    device = avatar.field.table.device
    kept_in = avatar.occupancy.density_grid if config.skipping == "canonical" else None
    warp = _warp(config.roots, avatar, config.replay_capacity, kept_in)
    field = PosedField(avatar.field, warp)
    emptiness: PosedEmptySpace
    match config.skipping:
        case "union":
            emptiness = SequenceGrid(
                avatar.rig, field, interval=config.occupancy_interval, device=device
            )
        case "frame":
            emptiness = PerFrameGrids(field, config.replay_capacity, device)
        case "none":
            emptiness = NoSkipping()
        case "canonical":
            emptiness = CorrespondenceBand(avatar.occupancy)
    return PosedSampler(avatar.field.backend, emptiness, warp, config.sample_step_m)


def _warp(
    roots: RootScheme, avatar: Avatar, slots: int, kept_in: DensityGrid | None
) -> CanonicalWarp:
    if roots == "broyden":
        return BroydenWarp(avatar.field, avatar.rig, slots, kept_in=kept_in)
    return CorrespondenceWarp(avatar.field, avatar.occupancy)


def render_sampler(
    avatar: Avatar,
    pose: BodyPose,
    cells: CorrespondenceGrid,
    *,
    skipping: SkippingScheme,
    roots: RootScheme = "cells",
) -> Callable[[RayBatch, CorrespondenceTables], RaySamples] | None:
    """Where samples lie when a pose is rendered by one of the schemes, for `avatar.render.render`.

    Args:
        avatar: Who is rendered.
        pose: Whose grid is filled, if the scheme has one.
        cells: The pose's warp.
        skipping: "frame" is the paper's way (§3.3, inference). "union" needs a sequence, which a
            new pose has none of, and is refused.
        roots: How samples are warped.

    Returns:
        None for our own scheme, which the renderer has already.

    Raises:
        ValueError: If the scheme is none of rendering.
    """
    if skipping == "union":
        raise ValueError(
            "A new pose belongs to no sequence, so there is no union over it: render with "
            "skipping='frame', as the paper does, or 'canonical' or 'none'."
        )
    if skipping == "canonical" and roots == "cells":
        return None
    device = avatar.field.table.device
    kept_in = avatar.rendering_grid() if skipping == "canonical" else None
    warp = _warp(roots, avatar, 1, kept_in)
    bones = avatar.rig.body_from_canonical(pose.joint_rotations)[:, :3].reshape(24, 12)
    warp.set_pose(0, torch.from_numpy(bones).float().to(device))
    emptiness: PosedEmptySpace = NoSkipping()
    if skipping == "frame":
        emptiness = _filled_grids(
            PerFrameGrids(PosedField(avatar.field, warp), 1, device), cells, device
        )
    elif skipping == "canonical":
        emptiness = CorrespondenceBand(avatar.occupancy)
    return PosedSampler(avatar.field.backend, emptiness, warp, avatar.sample_step_m).sample_rays


def _filled_grids(
    grids: PerFrameGrids, cells: CorrespondenceGrid, device: torch.device
) -> PerFrameGrids:
    tables = correspondence_tables(cells, device)
    generator = torch.Generator(device=device).manual_seed(0)
    grids.add_frame(0, tables)
    for _ in range(PROBES_PER_RENDERED_POSE):
        grids.probe(0, tables, generator)
    return grids

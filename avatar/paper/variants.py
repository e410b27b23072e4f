"""Which sampler a recipe asks for, in training and in rendering."""

from collections.abc import Callable

import torch

from avatar.cells import CorrespondenceGrid
from avatar.config import RootScheme, SkippingScheme, TrainConfig
from avatar.kernels.backend import CorrespondenceTables, DensityGrid, RayBatch, RaySamples
from avatar.model import Avatar
from avatar.paper.emptiness import CorrespondenceBand, PosedEmptySpace, NoSkipping
from avatar.paper.grids import PerFrameGrids, SequenceGrid
from avatar.paper.posed_field import PosedField
from avatar.paper.sampler import GlobalSparsitySampler, PosedSampler
from avatar.paper.warp import BroydenWarp, CorrespondenceWarp, CanonicalWarp
from avatar.render import correspondence_tables
from avatar.sampling import OccupancySampler, RaySampler
from preprocess.pose import BodyPose

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
            emptiness = SequenceGrid(avatar.rig, field, interval=config.occupancy_interval, device=device)
        case "frame":
            emptiness = PerFrameGrids(field, config.replay_capacity, device)
        case "none":
            emptiness = NoSkipping()
        case "canonical":
            emptiness = CorrespondenceBand(avatar.occupancy)
    return PosedSampler(avatar.field.backend, emptiness, warp, config.sample_step_m)


def _warp(roots: RootScheme, avatar: Avatar, slots: int, kept_in: DensityGrid | None) -> CanonicalWarp:
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
        emptiness = _filled_grids(PerFrameGrids(PosedField(avatar.field, warp), 1, device), cells, device)
    elif skipping == "canonical":
        emptiness = CorrespondenceBand(avatar.occupancy)
    return PosedSampler(avatar.field.backend, emptiness, warp, avatar.sample_step_m).sample_rays


def _filled_grids(grids: PerFrameGrids, cells: CorrespondenceGrid, device: torch.device) -> PerFrameGrids:
    tables = correspondence_tables(cells, device)
    generator = torch.Generator(device=device).manual_seed(0)
    grids.add_frame(0, tables)
    for _ in range(PROBES_PER_RENDERED_POSE):
        grids.probe(0, tables, generator)
    return grids

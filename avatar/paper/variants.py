"""Which sampler a recipe asks for, in training and in rendering."""

from collections.abc import Callable

import torch

from avatar.cells import WarpCells
from avatar.config import Roots, Skipping, TrainConfig
from avatar.kernels.backend import CellTables, Grid, Rays, Samples
from avatar.model import Avatar
from avatar.paper.emptiness import BandKnown, Emptiness, NothingKnown
from avatar.paper.grids import FrameGrids, UnionGrid
from avatar.paper.posed_field import PosedField
from avatar.paper.sampler import GloballySparse, PosedSampler
from avatar.paper.warp import BroydenWarp, CellWarp, Warp
from avatar.render import cell_tables
from avatar.sampling import CanonicalSampler, Sampler
from preprocess.pose import BodyPose

RENDERING_PASSES = 5
"""Probes of each cell when a pose is rendered, as in the released code."""


def sampler_for(config: TrainConfig, avatar: Avatar) -> Sampler:
    """The sampler that a recipe asks for."""
    sampler: Sampler
    if config.skipping == "canonical" and config.roots == "cells":
        sampler = CanonicalSampler(avatar.field.backend, avatar.occupancy, config)
    else:
        sampler = _posed_sampler(config, avatar)
    if config.empty_term == "occupancy":
        return sampler
    low, high = (torch.from_numpy(corner) for corner in (avatar.rig.box_low, avatar.rig.box_high))
    device = avatar.field.table.device
    return GloballySparse(sampler, low.to(device), high.to(device))


def _posed_sampler(config: TrainConfig, avatar: Avatar) -> PosedSampler:
    device = avatar.field.table.device
    kept_in = avatar.occupancy.grid if config.skipping == "canonical" else None
    warp = _warp(config.roots, avatar, config.key_frames, kept_in)
    field = PosedField(avatar.field, warp)
    emptiness: Emptiness
    match config.skipping:
        case "union":
            emptiness = UnionGrid(avatar.rig, field, every=config.occupancy_every, device=device)
        case "frame":
            emptiness = FrameGrids(field, config.key_frames, device)
        case "none":
            emptiness = NothingKnown()
        case "canonical":
            emptiness = BandKnown(avatar.occupancy)
    return PosedSampler(avatar.field.backend, emptiness, warp, config.step_m)


def _warp(roots: Roots, avatar: Avatar, slots: int, kept_in: Grid | None) -> Warp:
    if roots == "broyden":
        return BroydenWarp(avatar.field, avatar.rig, slots, kept_in=kept_in)
    return CellWarp(avatar.field, avatar.occupancy)


def rendering(
    avatar: Avatar,
    pose: BodyPose,
    cells: WarpCells,
    *,
    skipping: Skipping,
    roots: Roots = "cells",
) -> Callable[[Rays, CellTables], Samples] | None:
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
    warp.admit(0, torch.from_numpy(bones).float().to(device))
    emptiness: Emptiness = NothingKnown()
    if skipping == "frame":
        emptiness = _probed(FrameGrids(PosedField(avatar.field, warp), 1, device), cells, device)
    elif skipping == "canonical":
        emptiness = BandKnown(avatar.occupancy)
    return PosedSampler(avatar.field.backend, emptiness, warp, avatar.step_m).samples


def _probed(grids: FrameGrids, cells: WarpCells, device: torch.device) -> FrameGrids:
    tables = cell_tables(cells, device)
    generator = torch.Generator(device=device).manual_seed(0)
    grids.admit(0, tables)
    for _ in range(RENDERING_PASSES):
        grids.probe(0, tables, generator)
    return grids

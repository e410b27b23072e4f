"""Pictures of an avatar by exact volume rendering: nothing is cut short, nothing cached counts."""

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.cells import WarpCells
from avatar.field import Field
from avatar.kernels.backend import CellTables, Marching, Rays, Samples
from avatar.kernels.reference import MAX_LOG_DENSITY
from avatar.model import Avatar
from avatar.prepare import BodyRays
from capture.camera import Camera
from preprocess.pose import BodyPose

RAYS_AT_ONCE = 16384
MOST_SAMPLES = 512
AT_ONCE = 6
"""Samples of a ray that are asked for together."""
UNSEEN_DEPTH = 14.0
"""Optical depth behind which less than a millionth of the light comes from."""
EMPTY_LOG_DENSITY = -30.0


@torch.no_grad()
def render(
    avatar: Avatar,
    pose: BodyPose,
    camera: Camera,
    *,
    cells: WarpCells | None = None,
    samples_along: Callable[[Rays, CellTables], Samples] | None = None,
) -> Float32[np.ndarray, "height width 4"]:
    """Premultiplied RGBA in [0, 1] of the avatar in one pose, seen by one camera.

    Args:
        avatar: Who.
        pose: In the camera's world.
        camera: Also says how large the picture is.
        cells: The pose's warp, if it has been solved already.
        samples_along: Where samples lie, if not in the avatar's own occupancy
            (`avatar.paper.rendering`).
    """
    field = avatar.field
    device = field.table.device
    tables = cell_tables(cells or WarpCells.of(avatar.rig, pose.joint_rotations), device)
    width, height = camera.size_px
    rays = BodyRays.through(
        camera.pixel_centers().reshape(-1, 2), camera, avatar.rig.world_from_body(pose)
    )
    origin, directions = torch.from_numpy(rays.origin), torch.from_numpy(rays.directions)
    if samples_along is None:
        grid, how = avatar.rendering_grid(), Marching(avatar.step_m, math.inf, MOST_SAMPLES)
        samples_along = partial(field.backend.march, grid=grid, how=how)
    picture = torch.zeros(height * width, 4)
    for start in range(0, height * width, RAYS_AT_ONCE):
        chunk = directions[start : start + RAYS_AT_ONCE].to(device)
        batch = Rays(
            origin.to(device).expand(len(chunk), 3).contiguous(),
            chunk,
            torch.zeros(len(chunk), dtype=torch.int32, device=device),
            torch.full((len(chunk),), 0.5, device=device),
        )
        samples = samples_along(batch, tables)
        if len(samples.points):
            raw = _raw_as_far_as_seen(field, samples, avatar.step_m)
            colors = field.backend.composite(raw, samples, avatar.step_m)
            picture[start : start + len(chunk)] = colors.cpu()
    return picture.reshape(height, width, 4).numpy()


def _raw_as_far_as_seen(
    field: Field, samples: Samples, step_m: float
) -> Float32[Tensor, "samples 4"]:
    """Raw outputs of all samples that a millionth of the light reaches; the others stay empty.

    The field is asked front to back, a few samples of every ray at a time.
    """
    points, first, count, _ = samples
    ray = torch.repeat_interleave(torch.arange(len(count), device=points.device), count)
    rank = torch.arange(len(points), device=points.device) - first[ray]
    raw = points.new_zeros(len(points), 4)
    raw[:, 3] = EMPTY_LOG_DENSITY
    optical = points.new_zeros(len(count))
    for start in range(0, int(count.max()), AT_ONCE):
        lit = (rank >= start) & (rank < start + AT_ONCE) & (optical[ray] < UNSEEN_DEPTH)
        seen = lit.nonzero()[:, 0]
        if len(seen):
            values = field.raw_at(points[seen])
            raw[seen] = values
            density = torch.exp(values[:, 3].clamp(max=MAX_LOG_DENSITY))
            optical.index_add_(0, ray[seen], density * step_m)
    return raw


def cell_tables(cells: WarpCells, device: torch.device) -> CellTables:
    """One frame's warp cells as tables of a single slot."""
    return CellTables(
        torch.from_numpy(cells.index.reshape(1, -1)).to(device),
        torch.from_numpy(cells.roots[None]).to(device),
        torch.from_numpy(cells.low[None]).to(device),
        torch.tensor([cells.index.shape], dtype=torch.int32, device=device),
        cells.cell_m,
    )

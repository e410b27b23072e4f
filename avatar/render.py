"""Pictures of an avatar by exact volume rendering: nothing is cut short, nothing cached counts."""

import math

import numpy as np
import torch
from jaxtyping import Float32

from avatar.cells import WarpCells
from avatar.kernels.backend import CellTables, Marching, Rays
from avatar.model import Avatar
from avatar.prepare import BodyRays
from capture.camera import Camera
from preprocess.pose import BodyPose

RAYS_AT_ONCE = 16384
MOST_SAMPLES = 512


@torch.no_grad()
def render(
    avatar: Avatar, pose: BodyPose, camera: Camera, *, cells: WarpCells | None = None
) -> Float32[np.ndarray, "height width 4"]:
    """Premultiplied RGBA in [0, 1] of the avatar in one pose, seen by one camera.

    Args:
        avatar: Who.
        pose: In the camera's world.
        camera: Also says how large the picture is.
        cells: The pose's warp, if it has been solved already.
    """
    field = avatar.field
    device = field.table.device
    tables = cell_tables(cells or WarpCells.of(avatar.rig, pose.joint_rotations), device)
    width, height = camera.size_px
    rays = BodyRays.through(
        camera.pixel_centers().reshape(-1, 2), camera, avatar.rig.world_from_body(pose)
    )
    origin, directions = torch.from_numpy(rays.origin), torch.from_numpy(rays.directions)
    grid = avatar.rendering_grid()
    how = Marching(avatar.step_m, math.inf, MOST_SAMPLES)
    picture = torch.zeros(height * width, 4)
    for start in range(0, height * width, RAYS_AT_ONCE):
        chunk = directions[start : start + RAYS_AT_ONCE].to(device)
        batch = Rays(
            origin.to(device).expand(len(chunk), 3).contiguous(),
            chunk,
            torch.zeros(len(chunk), dtype=torch.int32, device=device),
            torch.full((len(chunk),), 0.5, device=device),
        )
        samples = field.backend.march(batch, tables, grid, how)
        if len(samples.points):
            raw = field.raw_at(samples.points)
            colors = field.backend.composite(raw, samples, avatar.step_m)
            picture[start : start + len(chunk)] = colors.cpu()
    return picture.reshape(height, width, 4).numpy()


def cell_tables(cells: WarpCells, device: torch.device) -> CellTables:
    """One frame's warp cells as tables of a single slot."""
    return CellTables(
        torch.from_numpy(cells.index.reshape(1, -1)).to(device),
        torch.from_numpy(cells.roots[None]).to(device),
        torch.from_numpy(cells.low[None]).to(device),
        torch.tensor([cells.index.shape], dtype=torch.int32, device=device),
        cells.cell_m,
    )

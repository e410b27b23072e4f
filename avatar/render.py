"""Pictures of an avatar by exact volume rendering: what is skipped is empty or not to be seen.

Rays are followed front to back, a few samples at a time, and the field is asked at every lattice
sample of an occupied cell until next to nothing of the light is left. What ends a ray is the
field's own density, never a cached one: those lie before the surface and cut it off.
"""

import math
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from avatar.deformation.correspondence_check import CorrespondenceCheck
from avatar.deformation.correspondence_grid import CorrespondenceGrid, cull_cells, screen_bounds
from avatar.field.avatar_model import Avatar
from avatar.field.radiance_field import RadianceField
from avatar.kernels.backend_protocol import (
    CorrespondenceTables,
    DensityGrid,
    MarchSettings,
    RayBatch,
    RaySamples,
)
from avatar.kernels.torch_reference import MAX_LOG_DENSITY
from avatar.training.training_frame import BodyFrameRays
from capture.camera import Camera
from preprocess.body.body_pose import BodyPose

RAYS_PER_CHUNK = 1 << 15
SAMPLES_PER_CHUNK = 1 << 15
MIN_SAMPLES_PER_PASS, MAX_SAMPLES_PER_PASS = 4, 8
"""Samples of a ray that are asked for together: more of them, the fewer rays are left."""
MIN_TRANSMITTANCE = 5e-6
"""Share of the light that may be left where a ray ends: no colour is farther off than this."""
EMPTY_LOG_DENSITY = -30.0


@torch.no_grad()
def render(
    avatar: Avatar,
    pose: BodyPose,
    camera: Camera,
    *,
    cells: CorrespondenceGrid | None = None,
    sample_rays: Callable[[RayBatch, CorrespondenceTables], RaySamples] | None = None,
) -> Float32[np.ndarray, "height width 4"]:
    """Premultiplied RGBA in [0, 1] of the avatar in one pose, seen by one camera.

    It is within `MIN_TRANSMITTANCE`, and what single precision rounds off, of the sum over all lattice samples
    in `avatar.rendering_grid()` that are on their rays (`avatar.deformation.correspondence_check`).

    Args:
        avatar: Who.
        pose: In the camera's world.
        camera: Also says how large the picture is.
        cells: The pose's warp, if it has been solved already.
        samples_along: Where samples lie, if not in the avatar's own occupancy
            (`baselines.instant_avatar.rendering`).
    """
    device = avatar.field.table.device
    cells = cells or CorrespondenceGrid.solve(avatar.rig, pose.joint_rotations, device=device)
    world_from_body = avatar.rig.world_from_body(pose)
    width, height = camera.size_px
    if sample_rays is None:
        grid = avatar.rendering_grid()
        cells = cull_cells(cells, grid)
        rows, columns = screen_bounds(cells, camera, world_from_body)
        strays = CorrespondenceCheck.for_pose(avatar.rig, pose.joint_rotations, cells, device)
        colors_of = partial(
            trace_rays, avatar.field, grid=grid, check=strays, sample_step_m=avatar.sample_step_m
        )
    else:
        rows, columns = slice(0, height), slice(0, width)
        colors_of = partial(
            _render_given_samples, avatar.field, sample_rays, sample_step_m=avatar.sample_step_m
        )
    tables = correspondence_tables(cells, avatar.field.table.device)
    picture = np.zeros((height, width, 4), dtype=np.float32)
    for part, pixels in _pixel_chunks(picture[rows, columns], rows.start, columns.start):
        rays = BodyFrameRays.through(pixels, camera, world_from_body)
        colors = colors_of(_ray_batch(rays, tables.low.device), tables)
        part[:] = colors.cpu().numpy().reshape(part.shape)
    return picture


def _pixel_chunks(
    image: Float32[np.ndarray, "height width 4"], top: int, left: int
) -> Iterator[tuple[Float32[np.ndarray, "rows width 4"], Float[np.ndarray, "pixels 2"]]]:
    """Some rows of a part of the picture after the other, and the centres of their pixels."""
    x = left + np.arange(image.shape[1]) + 0.5
    rows = max(1, RAYS_PER_CHUNK // max(len(x), 1))
    for first in range(0, len(image), rows):
        part = image[first : first + rows]
        y = top + first + np.arange(len(part)) + 0.5
        yield part, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def trace_rays(
    field: RadianceField,
    rays: RayBatch,
    cells: CorrespondenceTables,
    *,
    grid: DensityGrid,
    check: CorrespondenceCheck,
    sample_step_m: float,
) -> Float32[Tensor, "rays 4"]:
    """Premultiplied colour and alpha along rays.

    Args:
        field: What is seen.
        rays: Of one body frame or of many.
        cells: Their warps.
        grid: Where the field counts.
        strays: Finds samples that are not on their rays: these hold nothing.
        step_m: Distance between samples, metres.
    """
    colors = torch.zeros(len(rays.slots), 4, device=rays.origins.device)
    alive = torch.arange(len(colors), device=colors.device)
    while len(alive):
        most = min(max(SAMPLES_PER_CHUNK // len(alive), MIN_SAMPLES_PER_PASS), MAX_SAMPLES_PER_PASS)
        how = MarchSettings(sample_step_m, math.inf, most)
        samples, jitter = field.backend.march_resumable(rays, cells, grid, how)
        nearer = colors[alive]
        raw = field.raw_outputs_at(samples.points)
        raw[check.find_spurious(samples, rays), 3] = EMPTY_LOG_DENSITY
        part = field.backend.composite(raw, samples, sample_step_m)
        nearer = nearer + (1.0 - nearer[:, 3:]) * part
        colors[alive] = nearer
        on = ((samples.counts == most) & (nearer[:, 3] < 1.0 - MIN_TRANSMITTANCE)).nonzero()[:, 0]
        rays = RayBatch(rays.origins[on], rays.directions[on], rays.slots[on], jitter[on])
        alive = alive[on]
    return colors


def _render_given_samples(
    field: RadianceField,
    samples_along: Callable[[RayBatch, CorrespondenceTables], RaySamples],
    rays: RayBatch,
    cells: CorrespondenceTables,
    *,
    sample_step_m: float,
) -> Float32[Tensor, "rays 4"]:
    """Premultiplied colour and alpha along rays whose samples another scheme chooses.

    The field is asked front to back here, too: of what `MIN_TRANSMITTANCE` hides nothing is known.
    """
    samples = samples_along(rays, cells)
    points, first, count, _ = samples
    ray = torch.repeat_interleave(torch.arange(len(count), device=points.device), count)
    rank = torch.arange(len(points), device=points.device) - first[ray]
    raw = points.new_zeros(len(points), 4)
    raw[:, 3] = EMPTY_LOG_DENSITY
    optical = points.new_zeros(len(count))
    for start in range(0, int(count.max()) if len(count) else 0, MAX_SAMPLES_PER_PASS):
        lit = (
            (rank >= start)
            & (rank < start + MAX_SAMPLES_PER_PASS)
            & (optical[ray] < -math.log(MIN_TRANSMITTANCE))
        )
        seen = lit.nonzero()[:, 0]
        values = field.raw_outputs_at(points[seen])
        raw[seen] = values
        density = torch.exp(values[:, 3].clamp(max=MAX_LOG_DENSITY))
        optical.index_add_(0, ray[seen], density * sample_step_m)
    return field.backend.composite(raw, samples, sample_step_m)


def _ray_batch(rays: BodyFrameRays, device: torch.device) -> RayBatch:
    """Rays of one frame, whose samples lie in the middle of their steps."""
    directions = torch.from_numpy(rays.directions).to(device)
    count = len(directions)
    return RayBatch(
        torch.from_numpy(rays.origin).to(device).expand(count, 3).contiguous(),
        directions,
        torch.zeros(count, dtype=torch.int32, device=device),
        torch.full((count,), 0.5, device=device),
    )


def correspondence_tables(cells: CorrespondenceGrid, device: torch.device) -> CorrespondenceTables:
    """One frame's warp cells as tables of a single slot."""
    return CorrespondenceTables(
        torch.from_numpy(cells.packed_cells.reshape(1, -1)).to(device),
        torch.from_numpy(cells.roots[None]).to(device),
        torch.from_numpy(cells.low[None]).to(device),
        torch.tensor([cells.packed_cells.shape], dtype=torch.int32, device=device),
        cells.cell_m,
    )

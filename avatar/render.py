"""Renders an avatar by exact volume rendering: only empty or occluded samples are skipped.

Rays are marched front to back a few samples at a time, and the field is queried at every lattice
sample of an occupied cell until the transmittance falls below `MIN_TRANSMITTANCE`. The field's own
density ends a ray, never a cached one: cached densities lie in front of the surface and cut it off.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from avatar.avatar_model import Avatar, OrientationShading
from avatar.correspondence_grid import (
    CorrespondenceCheck,
    CorrespondenceGrid,
    cull_cells,
    screen_bounds,
)
from avatar.kernels import operations
from avatar.kernels.operands import CorrespondenceTables, DensityGrid, MarchSettings, RayBatch
from avatar.radiance_field import RadianceField
from capture.camera import Camera
from preprocess.body.body_pose import BodyPose

RAYS_PER_CHUNK = 1 << 15
"""Rays that are traced together; bounds the memory that a large image takes."""
MIN_TRANSMITTANCE = 5e-6
"""Transmittance at which a ray ends; it bounds the error of a pixel."""
EMPTY_LOG_DENSITY = -30.0
"""Log density (log 1/m) of a sample that counts as empty."""


def body_frame_rays(
    pixels: Float[np.ndarray, "rays 2"], camera: Camera, world_from_body: Float[np.ndarray, "4 4"]
) -> RayBatch:
    """Rays through image points, px, in the body frame; samples lie in mid-step."""
    rotation, translation = world_from_body[:3, :3], world_from_body[:3, 3]
    origin = ((camera.center_world - translation) @ rotation).astype(np.float32)
    directions = (camera.ray_directions(pixels) @ rotation).astype(np.float32)
    return RayBatch(
        origins=torch.from_numpy(origin).expand(len(pixels), 3).contiguous(),
        directions=torch.from_numpy(directions),
        slots=torch.zeros(len(pixels), dtype=torch.int32),
        jitter=torch.full((len(pixels),), 0.5),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedAvatar:
    """An avatar in one pose, ready to be seen by one camera.

    Attributes:
        grid: Occupancy outside which the field is taken to be empty.
        tables: Correspondence grid of the pose, without cells that lead to unoccupied space.
        bounds: Rows and columns of the image outside of which nothing is seen.
        shaded: Adds the light of the room to the colors, which are neutral otherwise.
    """

    avatar: Avatar
    camera: Camera
    world_from_body: Float[np.ndarray, "4 4"]
    grid: DensityGrid
    tables: CorrespondenceTables
    check: CorrespondenceCheck
    bounds: tuple[slice, slice]
    shaded: bool = False

    @classmethod
    def of(
        cls,
        avatar: Avatar,
        pose: BodyPose,
        camera: Camera,
        *,
        cells: CorrespondenceGrid | None = None,
        shaded: bool = False,
    ) -> "PosedAvatar":
        """Culls the correspondence grid of a pose, and solves it unless it is given."""
        cells = cells or CorrespondenceGrid.solve(avatar.rig, pose.joint_rotations)
        world_from_body = avatar.rig.world_from_body(pose)
        grid = avatar.rendering_grid()
        cells = cull_cells(cells, grid)
        return cls(
            avatar=avatar,
            camera=camera,
            world_from_body=world_from_body,
            grid=grid,
            tables=correspondence_tables(cells),
            check=CorrespondenceCheck.for_pose(avatar.rig, pose.joint_rotations, cells),
            bounds=screen_bounds(cells, camera, world_from_body),
            shaded=shaded,
        )

    @torch.no_grad()
    def colors_at(self, pixels: Float[np.ndarray, "pixels 2"]) -> Float32[np.ndarray, "pixels 4"]:
        """Premultiplied RGBA in [0, 1] at image points, px."""
        field = self.avatar.field
        rays = body_frame_rays(pixels, self.camera, self.world_from_body)
        shading = self.avatar.shading
        shading = shading if self.shaded and not shading.is_neutral else None
        colors, normals = trace_rays(
            field, rays, self.tables, grid=self.grid,
            check=self.check, sample_step_m=self.avatar.sample_step_m, shading=shading,
        )  # fmt: skip
        if shading is not None:
            rotation = torch.from_numpy(self.world_from_body[:3, :3]).to(normals)
            colors *= shading.factors(normals @ rotation.T)
        return colors.numpy()


def render(
    avatar: Avatar,
    pose: BodyPose,
    camera: Camera,
    *,
    cells: CorrespondenceGrid | None = None,
    shaded: bool = False,
) -> Float32[np.ndarray, "height width 4"]:
    """Renders an avatar in one pose as a premultiplied RGBA image in [0, 1].

    The image differs by at most `MIN_TRANSMITTANCE`, and single-precision rounding, from the sum
    over all lattice samples in `avatar.rendering_grid()` whose correspondences are valid
    (`avatar.correspondence_grid`).

    `cells` is the pose's correspondence grid, if it has been solved already. `shaded` adds the
    light of the room in which the person was filmed; colors are neutral otherwise, as in the
    package.
    """
    posed = PosedAvatar.of(avatar, pose, camera, cells=cells, shaded=shaded)
    width, height = camera.size_px
    picture = np.zeros((height, width, 4), dtype=np.float32)
    rows, columns = posed.bounds
    for part, pixels in pixel_chunks(picture[rows, columns], rows.start, columns.start):
        part[:] = posed.colors_at(pixels).reshape(part.shape)
    return picture


def pixel_chunks(
    image: Float32[np.ndarray, "height width 4"], top: int, left: int
) -> Iterator[tuple[Float32[np.ndarray, "rows width 4"], Float[np.ndarray, "pixels 2"]]]:
    """Blocks of rows of an image region, each with the centres of its pixels, px."""
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
    shading: OrientationShading | None = None,
) -> tuple[Float32[Tensor, "rays 4"], Float32[Tensor, "rays 3"]]:
    """Premultiplied neutral color and alpha along rays, and the normals of what they see.

    Density is taken to be zero outside `grid`, and at the samples that `check` finds spurious. The
    normals, in the body frame, are all zero without `shading`.
    """
    normals = torch.zeros(len(rays.slots), 3)
    colors = torch.zeros(len(rays.slots), 4)
    alive = torch.arange(len(colors))
    while len(alive):
        # the fewer rays are left, the more samples each; beyond 8 they lie behind the surface
        most = min(max((1 << 15) // len(alive), 4), 8)
        how = MarchSettings(sample_step_m, math.inf, most)
        samples, jitter = operations.march_resumable(rays, cells, grid, how)
        nearer = colors[alive]
        raw = field.raw_outputs_at(samples.points)
        raw[check.find_spurious(samples, rays), 3] = EMPTY_LOG_DENSITY
        part = operations.composite(raw, samples, sample_step_m)
        if shading is not None:
            found = operations.mean_normals(
                raw, samples, sample_step_m, rays.slots, cells, shading.normals
            )
            normals[alive] += (1.0 - nearer[:, 3:]) * found
        nearer = nearer + (1.0 - nearer[:, 3:]) * part
        colors[alive] = nearer
        on = ((samples.counts == most) & (nearer[:, 3] < 1.0 - MIN_TRANSMITTANCE)).nonzero()[:, 0]
        rays = RayBatch(rays.origins[on], rays.directions[on], rays.slots[on], jitter[on])
        alive = alive[on]
    return colors, normals


def correspondence_tables(cells: CorrespondenceGrid) -> CorrespondenceTables:
    """Correspondence tables with one slot, which holds the given grid."""
    return CorrespondenceTables(
        torch.from_numpy(cells.packed_cells.reshape(1, -1)),
        torch.from_numpy(cells.roots[None]),
        torch.from_numpy(cells.low[None]),
        torch.tensor([cells.packed_cells.shape], dtype=torch.int32),
        cells.cell_m,
    )

"""The avatar: rig, radiance field and occupancy of one person."""

from dataclasses import dataclass

import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.field.occupancy_grid import OccupancyGrid, in_occupied_cells
from avatar.field.orientation_shading import OrientationShading
from avatar.field.radiance_field import RadianceField
from avatar.kernels.backend_protocol import DensityGrid
from avatar.kernels.torch_reference import activate
from avatar.rig import Rig


@dataclass(frozen=True, eq=False, kw_only=True)
class Avatar:
    """A person who can be rendered in any pose.

    Attributes:
        rig: Articulation.
        field: Canonical color and density.
        occupancy: Occupied canonical cells.
        sample_step_m: Distance between samples along a ray in training, metres.
        shading: Light of the room in which the person was filmed.
    """

    rig: Rig
    field: RadianceField
    occupancy: OccupancyGrid
    sample_step_m: float
    shading: OrientationShading

    def rendering_grid(self) -> DensityGrid:
        """Occupancy for rendering, grown so that images have no holes."""
        return self.occupancy.for_rendering(self.sample_step_m)

    def color_and_density_at(
        self, points: Float32[Tensor, "points 3"]
    ) -> tuple[Float32[Tensor, "points 3"], Float32[Tensor, "points"]]:
        """Color in [0, 1] and density, 1/m, at canonical points; zero in empty cells."""
        held = in_occupied_cells(self.rendering_grid(), points).nonzero()[:, 0]
        color, density = activate(self.field.raw_outputs_at(points[held].contiguous()))
        all_colors, all_densities = torch.zeros_like(points), torch.zeros_like(points[:, 0])
        all_colors[held], all_densities[held] = color, density
        return all_colors, all_densities

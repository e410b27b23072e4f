"""The avatar: one person's rig, field and occupancy, as training left them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.field import Field
from avatar.kernels.backend import Grid
from avatar.kernels.reference import activate
from avatar.occupancy import Occupancy, inside
from avatar.rig import Rig


@dataclass(frozen=True, eq=False, kw_only=True)
class Avatar:
    """What can be rendered in any pose.

    Attributes:
        rig: Its articulation.
        field: Its canonical colour and density.
        occupancy: Where it may be.
        step_m: Distance between samples along a ray that it was trained with, metres.
    """

    rig: Rig
    field: Field
    occupancy: Occupancy
    step_m: float

    def rendering_grid(self) -> Grid:
        """Where a picture may show anything."""
        return self.occupancy.for_rendering(self.step_m)

    def field_at(
        self, points: Float32[Tensor, "points 3"]
    ) -> tuple[Float32[Tensor, "points 3"], Float32[Tensor, "points"]]:
        """Colour in [0, 1] and density in 1/m at canonical points; no density in empty cells."""
        held = inside(self.rendering_grid(), points).nonzero()[:, 0]
        color, density = activate(self.field.raw_at(points[held].contiguous()))
        all_colors, all_densities = torch.zeros_like(points), torch.zeros_like(points[:, 0])
        all_colors[held], all_densities[held] = color, density
        return all_colors, all_densities

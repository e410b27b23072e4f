"""The posed radiance field f'(x') = f(x*): the canonical field, asked in a body frame (§3.1)."""

from typing import NamedTuple, final

import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from avatar.field import RadianceField
from avatar.kernels.backend import CorrespondenceTables
from avatar.kernels.reference import MAX_LOG_DENSITY
from avatar.paper.warp import CanonicalWarp


class PosedDensities(NamedTuple):
    """Density at points of a body frame.

    Attributes:
        density: 1/m; 0 where a point has no canonical one.
        canonical: The canonical points of those that have one, in their order.
        found: Which have one.
    """

    density: Float32[Tensor, "points"]
    canonical: Float32[Tensor, "found 3"]
    has_root: Bool[Tensor, "points"]


@final
class PosedField:
    """A field and the warp through which it is seen in a pose."""

    def __init__(self, field: RadianceField, warp: CanonicalWarp) -> None:
        """The field's parameters and the warp's poses may change; they are read when asked."""
        self._field = field
        self._warp = warp

    def density_at(self, points: Float32[Tensor, "points 3"], slot: int, cells: CorrespondenceTables) -> PosedDensities:
        """The density at points of one slot's body frame."""
        slots = torch.full((len(points),), slot, dtype=torch.int32, device=points.device)
        warped = self._warp(points, slots, cells)
        log_density = self._field.raw_outputs_at(warped.points)[:, 3].clamp(max=MAX_LOG_DENSITY)
        density = points.new_zeros(len(points))
        density[warped.has_root] = torch.exp(log_density)
        return PosedDensities(density, warped.points, warped.has_root)

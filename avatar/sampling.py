"""Where a step looks along its rays: the seam between our scheme and the paper's."""

from typing import Protocol, final, runtime_checkable

import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.config import TrainConfig
from avatar.kernels.backend import Backend, CorrespondenceTables, MarchSettings, RayBatch, RaySamples
from avatar.occupancy import OccupancyGrid


@runtime_checkable
class RaySampler(Protocol):
    """Decides which canonical points a step asks the field about.

    Ours is `OccupancySampler`; the paper's are in `avatar.paper`.
    """

    def sample_rays(self, rays: RayBatch, cells: CorrespondenceTables) -> RaySamples:
        """Canonical samples along rays of the body frames that `cells` warps."""
        ...

    def sample_empty(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Canonical points that should hold nothing, at most `count`."""
        ...

    def sample_interior(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Canonical points where the body is solid, at most `count`."""
        ...

    def sample_inner_leg(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Canonical points off the skin between the legs, at most `count`."""
        ...

    def add_frame(self, slot: int, cells: CorrespondenceTables, bones: Float32[Tensor, "24 12"]) -> None:
        """Learns that a slot holds another frame from now on.

        Args:
            slot: Which.
            cells: The warp of all slots, this one's included.
            bones: From canonical to body frame, of the frame's pose.
        """
        ...

    def update(self, steps: int, cells: CorrespondenceTables, generator: torch.Generator) -> None:
        """Looks, after each step, whether what it knows of empty space must be renewed.

        Args:
            steps: How many were done before this one.
            cells: The warp of all slots.
            generator: Of everything random, on the field's device.
        """
        ...


@final
class OccupancySampler:
    """Ours: warp cells, then canonical occupancy, then an end where rays have become opaque."""

    def __init__(self, backend: Backend, occupancy: OccupancyGrid, config: TrainConfig) -> None:
        """RaySamples what `occupancy` holds; whoever owns that keeps it up to date."""
        self._backend = backend
        self._occupancy = occupancy
        self._march_settings = MarchSettings(config.sample_step_m, config.opaque_margin_m, config.max_samples)

    def sample_rays(self, rays: RayBatch, cells: CorrespondenceTables) -> RaySamples:
        """RaySamples of occupied cells, as far as the ray's cached optical depth lets it through."""
        return self._backend.march(rays, cells, self._occupancy.density_grid, self._march_settings)

    def sample_empty(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Random points of cells near the skin that hold nothing."""
        return self._occupancy.sample_empty(count, generator)

    def sample_interior(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Random points deep under the skin."""
        return self._occupancy.sample_interior(count, generator)

    def sample_inner_leg(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Random points off the skin between the legs."""
        return self._occupancy.sample_inner_leg(count, generator)

    def add_frame(self, slot: int, cells: CorrespondenceTables, bones: Float32[Tensor, "24 12"]) -> None:
        """Nothing to learn: canonical occupancy is every pose's."""

    def update(self, steps: int, cells: CorrespondenceTables, generator: torch.Generator) -> None:
        """Nothing to renew."""

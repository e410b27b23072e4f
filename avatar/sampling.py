"""Where a step looks along its rays: the seam between our scheme and the paper's."""

from typing import Protocol, final, runtime_checkable

import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.config import TrainConfig
from avatar.kernels.backend import Backend, CellTables, Marching, Rays, Samples
from avatar.occupancy import Occupancy


@runtime_checkable
class Sampler(Protocol):
    """Decides which canonical points a step asks the field about.

    Ours is `CanonicalSampler`; the paper's are in `avatar.paper`.
    """

    def samples(self, rays: Rays, cells: CellTables) -> Samples:
        """Canonical samples along rays of the body frames that `cells` warps."""
        ...

    def empty_points(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Canonical points that should hold nothing, at most `count`."""
        ...

    def solid_points(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Canonical points where the body is solid, at most `count`."""
        ...

    def gap_points(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Canonical points off the skin between the legs, at most `count`."""
        ...

    def admit(self, slot: int, cells: CellTables, bones: Float32[Tensor, "24 12"]) -> None:
        """Learns that a slot holds another frame from now on.

        Args:
            slot: Which.
            cells: The warp of all slots, this one's included.
            bones: From canonical to body frame, of the frame's pose.
        """
        ...

    def update(self, steps: int, cells: CellTables, generator: torch.Generator) -> None:
        """Looks, after each step, whether what it knows of empty space must be renewed.

        Args:
            steps: How many were done before this one.
            cells: The warp of all slots.
            generator: Of everything random, on the field's device.
        """
        ...


@final
class CanonicalSampler:
    """Ours: warp cells, then canonical occupancy, then an end where rays have become opaque."""

    def __init__(self, backend: Backend, occupancy: Occupancy, config: TrainConfig) -> None:
        """Samples what `occupancy` holds; whoever owns that keeps it up to date."""
        self._backend = backend
        self._occupancy = occupancy
        self._how = Marching(config.step_m, config.grace_m, config.most_samples)

    def samples(self, rays: Rays, cells: CellTables) -> Samples:
        """Samples of occupied cells, as far as the ray's cached optical depth lets it through."""
        return self._backend.march(rays, cells, self._occupancy.grid, self._how)

    def empty_points(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Random points of cells near the skin that hold nothing."""
        return self._occupancy.empty_points(count, generator)

    def solid_points(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Random points deep under the skin."""
        return self._occupancy.solid_points(count, generator)

    def gap_points(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Random points off the skin between the legs."""
        return self._occupancy.gap_points(count, generator)

    def admit(self, slot: int, cells: CellTables, bones: Float32[Tensor, "24 12"]) -> None:
        """Nothing to learn: canonical occupancy is every pose's."""

    def update(self, steps: int, cells: CellTables, generator: torch.Generator) -> None:
        """Nothing to renew."""

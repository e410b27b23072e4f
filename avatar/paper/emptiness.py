"""What a sampler of the body frame may know of empty space, from nothing to the band of the cells.

The paper's two grids are in `avatar.paper.grids`.
"""

from typing import Protocol, final, runtime_checkable

import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.kernels.backend import CorrespondenceTables, PosedOccupancy
from avatar.occupancy import OccupancyGrid


@runtime_checkable
class PosedEmptySpace(Protocol):
    """Where in each slot's body frame nothing needs to be asked."""

    def posed_occupancy(self, cells: CorrespondenceTables) -> PosedOccupancy:
        """Which cells of the body frames may hold something."""
        ...

    def sample_empty(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Canonical points of cells that hold nothing, at most `count`."""
        ...

    def add_frame(self, slot: int, cells: CorrespondenceTables) -> None:
        """Learns that a slot holds another frame from now on."""
        ...

    def update(self, steps: int, cells: CorrespondenceTables, generator: torch.Generator) -> None:
        """Renews what is known, if it is time."""
        ...


def person_boxes(
    cells: CorrespondenceTables,
) -> tuple[Float32[Tensor, "slots 3"], Float32[Tensor, "slots 3"]]:
    """Corners of the box about each slot's person, body frame: the near and far bound of rays."""
    return cells.low, cells.low + cells.shape * cells.cell_m


@final
class NoSkipping:
    """No skipping: every sample between the walls of the person's box is warped and asked."""

    def posed_occupancy(self, cells: CorrespondenceTables) -> PosedOccupancy:
        """A single cell, which is the box."""
        near, far = person_boxes(cells)
        one = torch.ones_like(cells.shape)
        return PosedOccupancy(one[:, :1], near, 1.0 / (far - near), one, near, far)

    def sample_empty(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """None."""
        return torch.zeros(0, 3, device=generator.device)

    def add_frame(self, slot: int, cells: CorrespondenceTables) -> None:
        """Nothing to learn."""

    def update(self, steps: int, cells: CorrespondenceTables, generator: torch.Generator) -> None:
        """Nothing to renew."""


@final
class CorrespondenceBand:
    """Ours before the warp: nothing lies where no warp cell has a root."""

    def __init__(self, occupancy: OccupancyGrid) -> None:
        """Empty points are those of canonical occupancy."""
        self._occupancy = occupancy

    def posed_occupancy(self, cells: CorrespondenceTables) -> PosedOccupancy:
        """The warp cells themselves."""
        per_m = torch.full_like(cells.low, 1.0 / cells.cell_m)
        return PosedOccupancy(cells.packed_cells, cells.low, per_m, cells.shape, *person_boxes(cells))

    def sample_empty(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Random points of canonical cells near the skin that hold nothing."""
        return self._occupancy.sample_empty(count, generator)

    def add_frame(self, slot: int, cells: CorrespondenceTables) -> None:
        """Nothing to learn: the cells say it."""

    def update(self, steps: int, cells: CorrespondenceTables, generator: torch.Generator) -> None:
        """Nothing to renew: whoever owns the occupancy does."""

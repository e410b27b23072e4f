"""What a sampler of the body frame may know of empty space, from nothing to the band of the cells.

The paper's two grids are in `avatar.paper.grids`.
"""

from typing import Protocol, final, runtime_checkable

import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.kernels.backend import CellTables, PosedGrid
from avatar.occupancy import Occupancy


@runtime_checkable
class Emptiness(Protocol):
    """Where in each slot's body frame nothing needs to be asked."""

    def grid(self, cells: CellTables) -> PosedGrid:
        """Which cells of the body frames may hold something."""
        ...

    def empty_points(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Canonical points of cells that hold nothing, at most `count`."""
        ...

    def admit(self, slot: int, cells: CellTables) -> None:
        """Learns that a slot holds another frame from now on."""
        ...

    def update(self, steps: int, cells: CellTables, generator: torch.Generator) -> None:
        """Renews what is known, if it is time."""
        ...


def persons_box(
    cells: CellTables,
) -> tuple[Float32[Tensor, "slots 3"], Float32[Tensor, "slots 3"]]:
    """Corners of the box about each slot's person, body frame: the near and far bound of rays."""
    return cells.low, cells.low + cells.shape * cells.cell_m


@final
class NothingKnown:
    """No skipping: every sample between the walls of the person's box is warped and asked."""

    def grid(self, cells: CellTables) -> PosedGrid:
        """A single cell, which is the box."""
        near, far = persons_box(cells)
        one = torch.ones_like(cells.shape)
        return PosedGrid(one[:, :1], near, 1.0 / (far - near), one, near, far)

    def empty_points(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """None."""
        return torch.zeros(0, 3, device=generator.device)

    def admit(self, slot: int, cells: CellTables) -> None:
        """Nothing to learn."""

    def update(self, steps: int, cells: CellTables, generator: torch.Generator) -> None:
        """Nothing to renew."""


@final
class BandKnown:
    """Ours before the warp: nothing lies where no warp cell has a root."""

    def __init__(self, occupancy: Occupancy) -> None:
        """Empty points are those of canonical occupancy."""
        self._occupancy = occupancy

    def grid(self, cells: CellTables) -> PosedGrid:
        """The warp cells themselves."""
        per_m = torch.full_like(cells.low, 1.0 / cells.cell_m)
        return PosedGrid(cells.index, cells.low, per_m, cells.shape, *persons_box(cells))

    def empty_points(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Random points of canonical cells near the skin that hold nothing."""
        return self._occupancy.empty_points(count, generator)

    def admit(self, slot: int, cells: CellTables) -> None:
        """Nothing to learn: the cells say it."""

    def update(self, steps: int, cells: CellTables, generator: torch.Generator) -> None:
        """Nothing to renew: whoever owns the occupancy does."""

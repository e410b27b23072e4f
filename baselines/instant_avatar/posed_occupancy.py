"""Occupancy in the body frame: none, that of the correspondence grid, and the paper's two grids.

The paper (§3.3) has one grid for the whole sequence and one for each pose. Both are 64³, in the
body frame (the paper's root-normalised space), filled by one jittered probe per cell of the posed
field, thresholded at an opacity of 0.01 per centimetre, and dilated by one cell. Decay, threshold
and passes are those of the released code.
"""

from typing import Protocol, final, runtime_checkable

import torch
from jaxtyping import Float32, Int64, UInt8
from torch import Tensor

from avatar.kernels.operands import CorrespondenceTables
from avatar.occupancy_grid import OccupancyGrid
from avatar.rig import Rig
from baselines.instant_avatar.occupied_samples import PosedOccupancy
from baselines.instant_avatar.posed_field import PosedField


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
        """No points, as no cell is known to be empty."""
        return torch.zeros(0, 3)

    def add_frame(self, slot: int, cells: CorrespondenceTables) -> None:
        """Ignored."""

    def update(self, steps: int, cells: CorrespondenceTables, generator: torch.Generator) -> None:
        """Nothing to renew."""


@final
class CorrespondenceBand:
    """Skips the cells of the correspondence grid that have no root."""

    def __init__(self, occupancy: OccupancyGrid) -> None:
        """Empty points are those of canonical occupancy."""
        self._occupancy = occupancy

    def posed_occupancy(self, cells: CorrespondenceTables) -> PosedOccupancy:
        """The cells of the correspondence grid."""
        per_m = torch.full_like(cells.low, 1.0 / cells.cell_m)
        return PosedOccupancy(
            cells.packed_cells, cells.low, per_m, cells.shape, *person_boxes(cells)
        )

    def sample_empty(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Random points of canonical cells near the skin that hold nothing."""
        return self._occupancy.sample_empty(count, generator)

    def add_frame(self, slot: int, cells: CorrespondenceTables) -> None:
        """Ignored; the correspondence grid holds the pose."""

    def update(self, steps: int, cells: CorrespondenceTables, generator: torch.Generator) -> None:
        """Nothing to renew; the owner of the occupancy updates it."""


GRID_CELLS = 64
GRID_DECAY = 0.8
"""Factor of a cell's density at each update."""
GRID_OPACITY = 0.01
"""Opacity of one centimetre below which, or below the mean if lower, a cell is empty."""
GRID_MARGIN_M = 0.25
"""Margin of the sequence's grid about the longest chain of bones, metres."""
FRAME_GRID_INTERVAL = 4
"""Steps between renewals of a frame's grid: with 100 frames each one's turn comes in 400 steps."""


def threshold_and_dilate(density: Float32[Tensor, "x y z"]) -> UInt8[Tensor, "x y z"]:
    """Cells that hold something, and all their neighbors."""
    opacity = 1.0 - torch.exp(-0.01 * density)
    full = (opacity > opacity.mean().clamp(max=GRID_OPACITY)).float()
    return torch.nn.functional.max_pool3d(full[None], 3, stride=1, padding=1)[0].to(torch.uint8)


def jittered_points(
    cells: Int64[Tensor, "cells 3"],
    low: Float32[Tensor, "3"],
    cell_m: Float32[Tensor, "3"],
    generator: torch.Generator,
) -> Float32[Tensor, "cells 3"]:
    """A random point in each of some cells of a grid, metres."""
    within = torch.rand(len(cells), 3, generator=generator)
    return low + (cells + within) * cell_m


def cells_in_block(
    first: tuple[int, int, int], last: tuple[int, int, int]
) -> Int64[Tensor, "cells 3"]:
    """The cells of a block, its last ones not included."""
    axes = [torch.arange(*ends) for ends in zip(first, last, strict=True)]
    return torch.cartesian_prod(*axes)


@final
class EmptyPointPool:
    """Canonical points that the latest probes found in empty cells."""

    def __init__(self) -> None:
        """Starts empty."""
        self._points = torch.zeros(0, 3)

    def fill(self, points: Float32[Tensor, "points 3"]) -> None:
        """Puts other points in the place of those that were there."""
        self._points = points

    def draw(self, count: int, generator: torch.Generator) -> Float32[Tensor, "drawn 3"]:
        """At most `count` of them, at random."""
        held = len(self._points)
        drawn = torch.randint(max(held, 1), (count if held else 0,), generator=generator)
        return self._points[drawn]


@final
class SequenceGrid:
    """Training, in the paper: the union over the sequence, as the moving maximum of one grid.

    As in the paper it forgets: what no drawn frame has shown for a few hundred steps is dropped.

    Attributes:
        density: 1/m.
        occupied: Everything, until the first update.
    """

    def __init__(self, rig: Rig, field: PosedField, *, interval: int) -> None:
        """A grid that knows nothing.

        Args:
            rig: Rig of the person; the grid is a cube about the pelvis that no pose leaves.
            field: Field that is probed.
            interval: Steps between updates.
        """
        reach = _reach(rig) + GRID_MARGIN_M
        pelvis = torch.from_numpy(rig.rest_joints[0]).float()
        self._field, self._every = field, interval
        self._low, self._cell_m = pelvis - reach, 2.0 * reach / GRID_CELLS
        self._slots: list[int] = []
        self._pool = EmptyPointPool()
        self.density: Float32[Tensor, "64 64 64"] = torch.zeros((GRID_CELLS,) * 3)
        self.occupied: UInt8[Tensor, "64 64 64"] = torch.ones((GRID_CELLS,) * 3, dtype=torch.uint8)

    def posed_occupancy(self, cells: CorrespondenceTables) -> PosedOccupancy:
        """The union grid, for every slot."""
        slots = len(cells.low)
        return PosedOccupancy(
            self.occupied.view(1, -1).expand(slots, -1),
            self._low.repeat(slots, 1),
            torch.full_like(cells.low, 1.0 / self._cell_m),
            torch.full_like(cells.shape, GRID_CELLS),
            *person_boxes(cells),
        )

    def sample_empty(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """From empty cells of the frame that was probed last."""
        return self._pool.draw(count, generator)

    def add_frame(self, slot: int, cells: CorrespondenceTables) -> None:
        """The frame will be drawn for updates."""
        if slot not in self._slots:
            self._slots.append(slot)

    def update(self, steps: int, cells: CorrespondenceTables, generator: torch.Generator) -> None:
        """Probes a random frame, at the grid's interval."""
        if steps % self._every == 0 and self._slots:
            drawn = torch.randint(len(self._slots), (1,), generator=generator)
            self.probe(self._slots[int(drawn)], cells, generator)

    def probe(self, slot: int, cells: CorrespondenceTables, generator: torch.Generator) -> None:
        """Takes in what one frame holds. Outside the person's box it holds nothing."""
        low, high = (corner[slot] - self._low for corner in person_boxes(cells))
        first = (low / self._cell_m).floor().long().clamp(0, GRID_CELLS).tolist()
        last = (high / self._cell_m).ceil().long().clamp(0, GRID_CELLS).tolist()
        block = cells_in_block(tuple(first), tuple(last))
        cell_m = torch.full_like(low, self._cell_m)
        probed = self._field.density_at(
            jittered_points(block, self._low, cell_m, generator), slot, cells
        )
        near = (block[:, 0] * GRID_CELLS + block[:, 1]) * GRID_CELLS + block[:, 2]
        flat = self.density.view(-1)
        flat *= GRID_DECAY
        flat[near] = torch.maximum(flat[near], probed.density)
        self.occupied = threshold_and_dilate(self.density)
        empty = self.occupied.view(-1)[near[probed.has_root]] == 0
        self._pool.fill(probed.canonical[empty])


@final
class PerFrameGrids:
    """Rendering, in the paper: a grid for each pose, over the person's own box.

    In training the grids are renewed in turn, each as a moving maximum.

    Attributes:
        density: 1/m, of every slot.
        occupied: Everything, until a slot's first probe.
    """

    def __init__(self, field: PosedField, slots: int) -> None:
        """Grids without frames."""
        self._field = field
        self._turn: list[int] = []
        self._pool = EmptyPointPool()
        cube = (slots, GRID_CELLS, GRID_CELLS, GRID_CELLS)
        self.density: Float32[Tensor, "slots 64 64 64"] = torch.zeros(cube)
        self.occupied: UInt8[Tensor, "slots 64 64 64"] = torch.zeros(cube, dtype=torch.uint8)
        self._low = torch.zeros(slots, 3)
        self._cell_m = torch.ones(slots, 3)

    def posed_occupancy(self, cells: CorrespondenceTables) -> PosedOccupancy:
        """Each slot's own, in the box that it had when it was probed."""
        shape = torch.full_like(cells.shape, GRID_CELLS)
        far = self._low + GRID_CELLS * self._cell_m
        occupied = self.occupied.flatten(1)
        return PosedOccupancy(occupied, self._low, 1.0 / self._cell_m, shape, self._low, far)

    def sample_empty(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """From empty cells of the grid that was renewed last."""
        return self._pool.draw(count, generator)

    def add_frame(self, slot: int, cells: CorrespondenceTables) -> None:
        """The slot's box is full until it is probed, and its turn is next."""
        if slot in self._turn:
            self._turn.remove(slot)
        self._turn.insert(0, slot)
        self._measure(slot, cells)
        self.density[slot] = 0.0
        self.occupied[slot] = 1

    def update(self, steps: int, cells: CorrespondenceTables, generator: torch.Generator) -> None:
        """Renews one slot's grid, every `FRAME_GRID_INTERVAL` steps."""
        if steps % FRAME_GRID_INTERVAL == 0 and self._turn:
            slot = self._turn.pop(0)
            self._turn.append(slot)
            self.density[slot] *= GRID_DECAY
            self._measure(slot, cells)
            self.probe(slot, cells, generator)

    def probe(self, slot: int, cells: CorrespondenceTables, generator: torch.Generator) -> None:
        """Raises one slot's densities to what a random point of each cell holds."""
        block = cells_in_block((0, 0, 0), (GRID_CELLS, GRID_CELLS, GRID_CELLS))
        points = jittered_points(block, self._low[slot], self._cell_m[slot], generator)
        probed = self._field.density_at(points, slot, cells)
        flat = self.density[slot].view(-1)
        torch.maximum(flat, probed.density, out=flat)
        self.occupied[slot] = threshold_and_dilate(self.density[slot])
        empty = self.occupied[slot].view(-1)[probed.has_root] == 0
        self._pool.fill(probed.canonical[empty])

    def _measure(self, slot: int, cells: CorrespondenceTables) -> None:
        self._low[slot] = cells.low[slot]
        self._cell_m[slot] = cells.shape[slot] * (cells.cell_m / GRID_CELLS)


def _reach(rig: Rig) -> float:
    """The longest chain of bones that hangs on the pelvis, metres."""
    lengths = [0.0] * len(rig.parents)
    for joint in range(1, len(rig.parents)):
        parent = int(rig.parents[joint])
        bone = rig.rest_joints[joint] - rig.rest_joints[parent]
        lengths[joint] = lengths[parent] + float((bone**2).sum() ** 0.5)
    return max(lengths)

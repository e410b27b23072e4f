"""Canonical occupancy: one density grid that all poses share, with its regions of interest.

The paper keeps grids in posed space, a union over the sequence for training and one per frame for
rendering. In canonical space a single grid is exact for every pose, forgets none, and needs no
evaluation of the field per frame.
"""

from collections.abc import Callable
from typing import final

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64, UInt8
from scipy.ndimage import label
from torch import Tensor

from avatar.kernels import numba_priors
from avatar.kernels.operands import (
    EMPTY_SPACE,
    HEAD_INTERIOR,
    INTERIOR,
    MAX_LOG_DENSITY,
    OFF_SKIN,
    DensityGrid,
)
from avatar.rig import CLOTHING_BAND_M, Rig
from preprocess.body.kinematics import HEAD_JOINT

OCCUPANCY_DECAY = 0.9
"""Factor of a probed cell's cached density. At 0.6 thin surfaces vanish."""
INITIAL_OCCUPANCY_DECAY = 0.7
"""The factor while the initial fog clears and each update probes half of the band."""
MIN_STEP_OPACITY = 0.02
"""Opacity of one step through a cell below which the cell is empty."""
NEAR_SKIN_M = 0.03
"""Distance from the skin within which a component's cells count towards its size, metres."""
MIN_COMPONENT_SHARE = 0.003
"""Size, relative to the largest component, below which a component is a floater."""
CALLS_PER_DRAW = 16
"""Calls whose random points are drawn at once; the empty cells change every sixteen steps."""


@final
class OccupancyGrid:
    """Occupied cells of canonical space.

    `density_grid` is updated in place; `band_cells` are the flat indices of the clothing band.
    """

    def __init__(self, rig: Rig) -> None:
        """Starts with the whole clothing band occupied."""
        band = torch.from_numpy(rig.skin_distance <= CLOTHING_BAND_M)
        self.density_grid = DensityGrid(
            occupied=band.to(torch.uint8),
            density=torch.where(band, 1e-3, 0.0),
            low=torch.from_numpy(rig.box_low),
            cells_per_m=torch.from_numpy(rig.cells_per_m),
        )
        self.band_cells: Int64[Tensor, " band"] = band.flatten().nonzero()[:, 0]
        self._band = self._in_band = band.to(torch.uint8)
        # metres: solid even if its shape fits badly
        interior = np.argwhere(rig.inside_skin & (rig.skin_distance > 0.015))
        weights = rig.weights_at(rig.box_low + (interior + 0.5) / rig.cells_per_m)
        flat = np.ravel_multi_index(tuple(interior.T), band.shape)
        self._deep_head_cells = torch.from_numpy(flat[weights[:, HEAD_JOINT] > 0.5])
        off_skin = torch.from_numpy(~rig.inside_skin & (rig.skin_distance > 0.03))  # off clothes
        self._cells_of_kind: dict[int, Tensor] = {
            INTERIOR: torch.from_numpy(flat),
            HEAD_INTERIOR: self._deep_head_cells,
            OFF_SKIN: (band & off_skin).flatten().nonzero()[:, 0],
        }
        self._near_skin = rig.skin_distance <= NEAR_SKIN_M
        self._cached_empty_cells: tuple[int, Tensor] | None = None
        self._floaters, self._updates = torch.zeros_like(self._in_band), 0
        self._ahead = dict[int, tuple[Tensor, int, list[Tensor]]]()

    def shape_face(self, before: Int64[Tensor, "before"], under: Int64[Tensor, "under"]) -> None:
        """Keeps cells before a face empty, and adds those under its skin to the head's interior.

        They are flat indices; those of an earlier call are forgotten.
        """
        self._in_band = self._band.clone()
        self._in_band.view(-1)[before] = 0
        self.density_grid.occupied.mul_(self._in_band)
        self._cells_of_kind[HEAD_INTERIOR] = torch.cat([self._deep_head_cells, under])

    @torch.no_grad()
    def update(
        self,
        log_density_at: Callable[[Float32[Tensor, "points 3"]], Float32[Tensor, "points"]],
        *,
        share: float,
        decay: float = OCCUPANCY_DECAY,
        min_density: float = 0.0,
        drop_floaters: bool = False,
        sample_step_m: float,
        generator: torch.Generator,
    ) -> None:
        """Probes a share of the band, once per cell at a random place, and updates the occupancy.

        Args:
            share: Share of the cells; every second, third, ... cell, and the next ones in the next
                update.
            decay: Factor of a probed cell's cached density.
            min_density: Density below which a cell is empty whatever the step, 1/m.
            drop_floaters: Drops small components, and those off the skin. (The paper's code keeps
                the largest component only, but a foot may be one of its own.)
        """
        every = round(1.0 / share)
        chosen = self.band_cells[self._updates % every :: every].contiguous()
        points = self._random_places(chosen, generator)
        density = torch.exp(log_density_at(points).clamp(max=MAX_LOG_DENSITY))
        flat = self.density_grid.density.view(-1)
        flat[chosen] = torch.maximum(flat[chosen] * decay, density)
        least = max(self._density_threshold(sample_step_m), min_density)
        occupied = dilate((self.density_grid.density > least).view(torch.uint8)) & self._in_band
        if drop_floaters:
            if self._updates % 8 == 0:
                solid = self.density_grid.density > 20.0  # 1/m
                self._floaters = find_floaters(solid, self._near_skin)
            occupied &= 1 - self._floaters
        self._updates += 1
        self.density_grid.occupied.copy_(occupied)

    def for_rendering(self, sample_step_m: float) -> DensityGrid:
        """The occupancy dilated by one more cell, so that culling leaves no hole in an image.

        Dilated cells are kept only next to cells of at least half the occupancy threshold, a step
        of the paper's 1 % opacity. This saves a quarter of the samples and stays as close to the
        sum over all samples as full dilation does.
        """
        hazy = (self.density_grid.density > 0.5 * self._density_threshold(sample_step_m)).to(
            torch.uint8
        )
        return self.density_grid._replace(
            occupied=dilate(self.density_grid.occupied) & dilate(hazy)
        )

    def _density_threshold(self, step_m: float) -> float:
        """Density from which a cell is occupied, 1/m: the mean of the band while all is fog."""
        return min(
            MIN_STEP_OPACITY / step_m,
            float(self.density_grid.density.view(-1)[self.band_cells].mean()),
        )

    def sample(
        self, kind: int, count: int, generator: torch.Generator
    ) -> Float32[Tensor, "points 3"]:
        """Random points, at most `count`, where priors of a kind hold.

        `EMPTY_SPACE` is unoccupied cells of the band, and `OFF_SKIN` its cells off the skin; those
        of `INTERIOR` and `HEAD_INTERIOR` lie deep under it. Points are drawn for many calls at
        once, and drawn again when the cells, or `count`, are others.
        """
        cells = self._empty_cells() if kind == EMPTY_SPACE else self._cells_of_kind[kind]
        of, each, ahead = self._ahead.get(kind, (None, 0, []))
        if of is not cells or each != count or not ahead:
            size = (count * CALLS_PER_DRAW if len(cells) else 0,)
            drawn = torch.randint(max(len(cells), 1), size, generator=generator)
            ahead = list(self._random_places(cells[drawn], generator).chunk(CALLS_PER_DRAW))
            self._ahead[kind] = cells, count, ahead
        return ahead.pop()

    def _empty_cells(self) -> Int64[Tensor, "cells"]:
        """Unoccupied cells of the band, cached until the occupancy changes."""
        version = self.density_grid.occupied._version
        if self._cached_empty_cells is None or self._cached_empty_cells[0] != version:
            cells = self.band_cells[self.density_grid.occupied.view(-1)[self.band_cells] == 0]
            self._cached_empty_cells = version, cells
        return self._cached_empty_cells[1]

    def _random_places(
        self, cells: Int64[Tensor, "cells"], generator: torch.Generator
    ) -> Float32[Tensor, "cells 3"]:
        """A random point in each cell."""
        grid, within = self.density_grid, torch.rand(len(cells), 3, generator=generator)
        points = torch.empty(len(cells), 3)
        numba_priors.points_in_cells(
            cells.numpy(), within.numpy(), tuple(grid.occupied.shape), grid.low.numpy(),
            grid.cells_per_m.numpy(), points.numpy(),
        )  # fmt: skip
        return points


def in_occupied_cells(
    grid: DensityGrid, points: Float32[Tensor, "points 3"]
) -> Bool[Tensor, "points"]:
    """Mask of the points that lie in occupied cells."""
    shape = torch.tensor(grid.occupied.shape)
    cell = torch.floor((points - grid.low) * grid.cells_per_m).long()
    x, y, z = torch.minimum(cell.clamp(min=0), shape - 1).unbind(dim=1)
    return ((cell >= 0) & (cell < shape)).all(dim=1) & (grid.occupied[x, y, z] != 0)


def dilate(occupied: UInt8[Tensor, "x y z"]) -> UInt8[Tensor, "x y z"]:
    """The cells and their six neighbors."""
    out = occupied.clone()
    for axis in range(3):
        length = occupied.shape[axis] - 1
        out.narrow(axis, 1, length).bitwise_or_(occupied.narrow(axis, 0, length))
        out.narrow(axis, 0, length).bitwise_or_(occupied.narrow(axis, 1, length))
    return out


def find_floaters(
    solid: Bool[Tensor, "x y z"], near_skin: Bool[np.ndarray, "x y z"]
) -> UInt8[Tensor, "x y z"]:
    """Cells in and about the connected components that are not part of the person.

    A component's size is the number of its solid cells near the skin.
    """
    # scipy has no types, and what pyright guesses of this function is wrong
    pieces, count = label(solid.numpy())  # pyright: ignore[reportGeneralTypeIssues]
    if count < 2:
        return torch.zeros_like(solid, dtype=torch.uint8)
    sizes = np.bincount(pieces[near_skin], minlength=count + 1)
    sizes[0] = 0
    kept = (sizes >= MIN_COMPONENT_SHARE * sizes.max()).astype(np.uint8)
    gone = 1 - kept
    kept[0] = gone[0] = 0

    def about(chosen: UInt8[np.ndarray, "pieces"]) -> UInt8[Tensor, "x y z"]:
        return dilate(dilate(torch.from_numpy(chosen[np.asarray(pieces, dtype=np.int32)])))

    return about(gone) & (1 - about(kept))

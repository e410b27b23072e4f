"""One seam for the fast path: the operations of a step, on whatever runs them."""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32, Int32, Int64, UInt8
from torch import Tensor

from avatar.deformation.rig import Rig
from avatar.kernels.hash_levels import HashLevels

Points = Float32[Tensor, "points 3"]
"""Canonical positions, metres."""
Features = Float32[Tensor, "points width"]
"""What the hash grid holds at points."""
HashTable = Float32[Tensor, "entries 4"]
"""The hash grid's entries, level after level."""
RawOutputs = Float32[Tensor, "samples 4"]
"""The network's outputs: colour logits and log density (log 1/m)."""
PremultipliedPixels = Float32[Tensor, "rays 4"]
"""Premultiplied colour and alpha."""


class RaySamples(NamedTuple):
    """Canonical samples of a batch of rays, packed ray by ray.

    Attributes:
        points: Canonical positions, metres.
        first: Where each ray's samples begin.
        count: How many each ray has.
        rows: Root of its frame's cells that each sample was warped with.
    """

    points: Float32[Tensor, "samples 3"]
    offsets: Int64[Tensor, "rays"]
    counts: Int32[Tensor, "rays"]
    root_rows: Int32[Tensor, "samples"]


class RayBatch(NamedTuple):
    """Rays in the body frame of the frame that each belongs to.

    Attributes:
        origins: Metres.
        directions: Unit vectors.
        slots: Which frame's warp cells each ray runs through.
        jitter: Offset of each ray's sample lattice, in steps; 1 and more passes so many samples
            over.
    """

    origins: Float32[Tensor, "rays 3"]
    directions: Float32[Tensor, "rays 3"]
    slots: Int32[Tensor, "rays"]
    jitter: Float32[Tensor, "rays"]


class CorrespondenceTables(NamedTuple):
    """Warp cells of many frames, one slot each (`avatar.deformation.correspondence_grid.WarpCells`, padded).

    Attributes:
        index: `first_row * 8 + bent * 4 + count` of each cell. Where nothing is near it is 0, or -n
            to say that all cells less than n away hold nothing either.
        roots: Roots and how the warp moves about them.
        low: Corner of each slot's grid, body frame, metres.
        shape: Cells along each axis of each slot's grid.
        cell_m: Edge of a cell, metres.
    """

    packed_cells: Int32[Tensor, "slots cells"]
    roots: Float32[Tensor, "slots roots 12"]
    low: Float32[Tensor, "slots 3"]
    shape: Int32[Tensor, "slots 3"]
    cell_m: float


class SolvedCorrespondences(NamedTuple):
    """The warp cells of one frame (`avatar.deformation.correspondence_grid.WarpCells`).

    Attributes:
        low: Corner of their grid, body frame, metres.
        index: `first_row * 8 + bent * 4 + count` of each cell.
        roots: Roots and how the warp moves about them.
    """

    low: Float32[np.ndarray, "3"]
    packed_cells: Int32[np.ndarray, "gx gy gz"]
    roots: Float32[np.ndarray, "rows 12"]


class DensityGrid(NamedTuple):
    """Canonical occupancy: which cells may hold anything, and the density last seen there.

    Attributes:
        occupied: 0 or 1.
        density: 1/m.
        low: Corner of the box, metres.
        cells_per_m: Along each axis.
    """

    occupied: UInt8[Tensor, "x y z"]
    density: Float32[Tensor, "x y z"]
    low: Float32[Tensor, "3"]
    cells_per_m: Float32[Tensor, "3"]


class SkinningVolume(NamedTuple):
    """The skinning volume (`avatar.deformation.rig.Rig`).

    Attributes:
        weights: On the nodes of the canonical box.
        low: Its corner, metres.
        nodes_per_m: Nodes per metre along each axis.
    """

    weights: Float32[Tensor, "x y z 24"]
    low: Float32[Tensor, "3"]
    nodes_per_m: Float32[Tensor, "3"]


class MarchSettings(NamedTuple):
    """How a ray is sampled.

    Attributes:
        step_m: Distance between samples, metres.
        grace_m: How much farther a ray is followed once its cached optical depth says it is
            opaque; infinity for exact rendering. Metres, never a number of samples: a grace that
            shrinks with the step cuts grazing rays before the surface.
        most: Samples a ray may have.
    """

    sample_step_m: float
    opaque_margin_m: float
    max_samples: int

    @property
    def opaque_margin_steps(self) -> int:
        """The grace in samples."""
        return int(min(self.opaque_margin_m / self.sample_step_m + 1.0, 1e9))


@runtime_checkable
class Backend(Protocol):
    """The operations of a training step. `avatar.kernels.torch_reference` says what each means."""

    name: str

    def encode(self, points: Points, table: HashTable, levels: HashLevels) -> Features:
        """Hash-grid features."""
        ...

    def encode_backward(
        self, points: Points, grad_features: Features, levels: HashLevels, grad_table: HashTable
    ) -> None:
        """Adds the table's gradient to `grad_table`."""
        ...

    def encode_points_backward(
        self, points: Points, grad_features: Features, table: HashTable, levels: HashLevels
    ) -> Points:
        """Gradient of the features with respect to the points."""
        ...

    def solve_correspondences(
        self,
        rig: Rig,
        bones: Float32[np.ndarray, "24 12"],
        band_m: float,
        cell_m: float,
        device: torch.device,
    ) -> SolvedCorrespondences:
        """The warp of a pose whose bones go from the canonical to the body frame."""
        ...

    def march(
        self, rays: RayBatch, cells: CorrespondenceTables, grid: DensityGrid, how: MarchSettings
    ) -> RaySamples:
        """Canonical samples along rays."""
        ...

    def march_resumable(
        self, rays: RayBatch, cells: CorrespondenceTables, grid: DensityGrid, how: MarchSettings
    ) -> tuple[RaySamples, Float32[Tensor, "rays"]]:
        """The same, and the jitter with which each ray goes on that has all its `how.most`."""
        ...

    def composite(self, raw: RawOutputs, samples: RaySamples, step_m: float) -> PremultipliedPixels:
        """Premultiplied colour and alpha of each ray."""
        ...

    def composite_loss(
        self,
        raw: RawOutputs,
        samples: RaySamples,
        step_m: float,
        target: PremultipliedPixels,
        background: Float32[Tensor, "rays 3"],
        alpha_weight: float,
        hard_weight: float,
    ) -> tuple[PremultipliedPixels, Float32[Tensor, "rays"], RawOutputs]:
        """Rendering, loss of each ray, and the gradient of the mean loss for `raw`."""
        ...

    def scatter_max_density(
        self, points: Points, log_density: Float32[Tensor, "points"], grid: DensityGrid
    ) -> None:
        """Raises the grid's cached density, in place, to that of the samples."""
        ...

    def bone_wrenches(
        self,
        samples: RaySamples,
        grad_points: Float32[Tensor, "samples 3"],
        slots: Int32[Tensor, "rays"],
        cells: CorrespondenceTables,
        skin: SkinningVolume,
        bones: Float32[Tensor, "slots 24 12"],
    ) -> Float32[Tensor, "rays 24 6"]:
        """What each ray's samples, pulled so, exert on the bones that move them."""
        ...

    def update_roots(
        self,
        cells: CorrespondenceTables,
        slot: int,
        skin: SkinningVolume,
        bones: Float32[Tensor, "24 12"],
    ) -> None:
        """Moves a slot's roots, in place, after its pose."""
        ...

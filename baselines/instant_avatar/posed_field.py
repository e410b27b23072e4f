"""The posed radiance field f'(x') = f(x*) (§3.1), by our correspondences or by root finding."""

import math
from typing import NamedTuple, Protocol, final, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from avatar.kernels import operations
from avatar.kernels.operands import (
    MAX_LOG_DENSITY,
    CorrespondenceTables,
    DensityGrid,
    MarchSettings,
    RayBatch,
)
from avatar.occupancy_grid import OccupancyGrid, in_occupied_cells
from avatar.radiance_field import RadianceField
from avatar.rig import Rig
from baselines.instant_avatar.broyden_kernels import (
    START_BONES,
    BlendedTransforms,
    find_all_roots,
)

ONE_SAMPLE_STEP_M = 1e3
"""Step that leaves every box at once, metres: a ray is sampled at its origin only."""


class CanonicalPoints(NamedTuple):
    """Canonical points of those posed samples that have one.

    Attributes:
        points: Canonical points of the samples that have one, in their order.
        root_rows: Root row that each was warped with; 0 without a correspondence grid.
        has_root: Which samples have a canonical point.
    """

    points: Float32[Tensor, "found 3"]
    root_rows: Int32[Tensor, "has_root"]
    has_root: Bool[Tensor, "samples"]


@runtime_checkable
class CanonicalWarp(Protocol):
    """From the body frames of slots to canonical space."""

    def __call__(
        self,
        points: Float32[Tensor, "samples 3"],
        slots: Int32[Tensor, "samples"],
        cells: CorrespondenceTables,
    ) -> CanonicalPoints:
        """The canonical points of posed samples."""
        ...

    def set_pose(self, slot: int, bones: Float32[Tensor, "24 12"]) -> None:
        """Learns that a slot holds another pose from now on."""
        ...


@final
class CorrespondenceWarp:
    """Warp cells; of several roots the one of highest cached density counts."""

    def __init__(self, occupancy: OccupancyGrid) -> None:
        """Chooses between roots by what `occupancy` has cached, whether or not it is occupied."""
        everywhere = torch.ones_like(occupancy.density_grid.occupied)
        self._grid = occupancy.density_grid._replace(occupied=everywhere)

    def __call__(
        self,
        points: Float32[Tensor, "samples 3"],
        slots: Int32[Tensor, "samples"],
        cells: CorrespondenceTables,
    ) -> CanonicalPoints:
        """Each sample is a ray of its own, and marching asks for its first point."""
        along = points.new_tensor([0.6, 0.64, 0.48]).expand(len(points), 3).contiguous()
        rays = RayBatch(points, along, slots, points.new_zeros(len(points)))
        samples = operations.march(
            rays, cells, self._grid, MarchSettings(ONE_SAMPLE_STEP_M, math.inf, 1)
        )
        return CanonicalPoints(samples.points, samples.root_rows, samples.counts > 0)

    def set_pose(self, slot: int, bones: Float32[Tensor, "24 12"]) -> None:
        """Ignored; the correspondence grid holds the pose."""


@final
class BroydenWarp:
    """Root finding for each sample; all its roots are asked, and the densest one counts (§3.2).

    Blended transforms of every slot stay in memory, about 11 MB each.
    """

    def __init__(
        self, field: RadianceField, rig: Rig, slots: int, *, kept_in: DensityGrid | None = None
    ) -> None:
        """A warp without poses.

        Args:
            field: Field that ranks the roots.
            rig: Rig of the person.
            slots: Number of poses that it holds.
            kept_in: Only roots in its occupied cells count; None for those in the rig's box.
        """
        self._field = field
        self._weights = torch.from_numpy(rig.weights)
        self._low = torch.from_numpy(rig.box_low)
        self._high = torch.from_numpy(rig.box_high)
        self._kept_in = kept_in
        nodes = torch.tensor(self._weights.shape[:3]) - 1
        self.poses = BlendedTransforms(
            # untouched memory costs nothing: pages are committed when they are written
            blended=torch.empty(slots, *self._weights.shape[:3], 12),
            low=self._low,
            nodes_per_m=nodes / (self._high - self._low),
            inverses=torch.zeros(slots, len(START_BONES), 12),
        )

    def set_pose(self, slot: int, bones: Float32[Tensor, "24 12"]) -> None:
        """Blends the pose's transforms, and inverts those of the bones that searches start with."""
        torch.matmul(self._weights, bones, out=self.poses.blended[slot])
        square = np.tile(np.eye(4), (len(START_BONES), 1, 1))
        square[:, :3] = bones[list(START_BONES)].numpy().reshape(-1, 3, 4)
        inverses = np.linalg.inv(square)[:, :3].reshape(-1, 12)
        self.poses.inverses[slot] = torch.from_numpy(inverses).to(bones)

    def __call__(
        self,
        points: Float32[Tensor, "samples 3"],
        slots: Int32[Tensor, "samples"],
        cells: CorrespondenceTables,
    ) -> CanonicalPoints:
        """The densest root of each sample; the field is queried only where there are several."""
        roots, valid = find_all_roots(points, slots, self.poses)
        valid &= self._is_accepted(roots)
        several = (valid.sum(dim=1) > 1).nonzero()[:, 0]
        best = valid.int().argmax(dim=1)
        if len(several):
            held = valid[several]
            score = torch.full(held.shape, -math.inf)
            score[held] = self._field.raw_outputs_at(roots[several][held].contiguous())[:, 3]
            best[several] = score.argmax(dim=1)
        found = valid.any(dim=1)
        chosen = roots[found, best[found]]
        return CanonicalPoints(chosen, chosen.new_zeros(len(chosen), dtype=torch.int32), found)

    def _is_accepted(
        self, roots: Float32[Tensor, "samples starts 3"]
    ) -> Bool[Tensor, "samples starts"]:
        if self._kept_in is not None:
            flat = in_occupied_cells(self._kept_in, roots.flatten(0, 1))
            return flat.unflatten(0, roots.shape[:2])
        return ((roots >= self._low) & (roots <= self._high)).all(dim=-1)


class PosedDensities(NamedTuple):
    """Density at points of a body frame.

    Attributes:
        density: Density, 1/m; 0 where a point has no canonical one.
        canonical: Canonical points of the points that have one, in their order.
        has_root: Which points have one.
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

    def density_at(
        self, points: Float32[Tensor, "points 3"], slot: int, cells: CorrespondenceTables
    ) -> PosedDensities:
        """The density at points of one slot's body frame."""
        slots = torch.full((len(points),), slot, dtype=torch.int32)
        warped = self._warp(points, slots, cells)
        log_density = self._field.raw_outputs_at(warped.points)[:, 3].clamp(max=MAX_LOG_DENSITY)
        density = points.new_zeros(len(points))
        density[warped.has_root] = torch.exp(log_density)
        return PosedDensities(density, warped.points, warped.has_root)

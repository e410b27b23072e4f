"""The paper's order of things: skip in the body frame, warp what is left, ask all of it."""

from typing import final

import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.kernels.backend import Backend, CorrespondenceTables, RayBatch, RaySamples
from avatar.paper.emptiness import PosedEmptySpace
from avatar.paper.warp import CanonicalWarp
from avatar.sampling import RaySampler


@final
class PosedSampler:
    """RaySamples of the body frame that are not known to be empty, each warped on its own.

    No ray ends early: every sample up to the far wall of the person's box is there.
    """

    def __init__(self, backend: Backend, emptiness: PosedEmptySpace, warp: CanonicalWarp, step_m: float) -> None:
        """A sampler.

        Args:
            backend: Places samples.
            emptiness: Where none need be.
            warp: Carries them to canonical space.
            step_m: Distance between samples along a ray, metres.
        """
        self._backend, self._emptiness = backend, emptiness
        self._warp, self._step_m = warp, step_m

    def sample_rays(self, rays: RayBatch, cells: CorrespondenceTables) -> RaySamples:
        """Canonical samples along rays; what has no canonical point is left out."""
        points, placed = self._backend.sample_occupied_cells(rays, self._emptiness.posed_occupancy(cells), self._step_m)
        slots = rays.slots.repeat_interleave(placed)
        warped = self._warp(points, slots, cells)
        before = torch.nn.functional.pad(torch.cumsum(warped.has_root.int(), 0), (1, 0))
        last = torch.cumsum(placed, 0)
        first = before[last - placed]
        count = before[last] - first
        return RaySamples(warped.points, first, count.int(), warped.root_rows)

    def sample_empty(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """What is known to be empty."""
        return self._emptiness.sample_empty(count, generator)

    def sample_interior(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """None: the paper asks nothing of them."""
        return torch.zeros(0, 3, device=generator.device)

    def sample_inner_leg(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """None, likewise."""
        return torch.zeros(0, 3, device=generator.device)

    def add_frame(self, slot: int, cells: CorrespondenceTables, bones: Float32[Tensor, "24 12"]) -> None:
        """Both parts learn of the frame."""
        self._warp.set_pose(slot, bones)
        self._emptiness.add_frame(slot, cells)

    def update(self, steps: int, cells: CorrespondenceTables, generator: torch.Generator) -> None:
        """Grids are renewed when it is time."""
        self._emptiness.update(steps, cells, generator)


@final
class GlobalSparsitySampler:
    """Another sampler, but emptiness is asked for everywhere: the paper's Global Sparsity.

    The prior that the paper's Fig. 5 compares with: it biases the density of every point towards
    zero, the person's own included.
    """

    def __init__(
        self, sampler: RaySampler, low: Float32[Tensor, "3"], high: Float32[Tensor, "3"]
    ) -> None:
        """Asks for emptiness anywhere in the box between two corners."""
        self._sampler, self._low, self._high = sampler, low, high

    def sample_rays(self, rays: RayBatch, cells: CorrespondenceTables) -> RaySamples:
        """The other's."""
        return self._sampler.sample_rays(rays, cells)

    def sample_empty(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Random points of the whole box."""
        place = torch.rand(count, 3, generator=generator, device=generator.device)
        return self._low + place.to(self._low.device) * (self._high - self._low)

    def sample_interior(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """The other's."""
        return self._sampler.sample_interior(count, generator)

    def sample_inner_leg(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """The other's."""
        return self._sampler.sample_inner_leg(count, generator)

    def add_frame(self, slot: int, cells: CorrespondenceTables, bones: Float32[Tensor, "24 12"]) -> None:
        """The other learns of it."""
        self._sampler.add_frame(slot, cells, bones)

    def update(self, steps: int, cells: CorrespondenceTables, generator: torch.Generator) -> None:
        """The other is renewed."""
        self._sampler.update(steps, cells, generator)

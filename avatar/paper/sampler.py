"""The paper's order of things: skip in the body frame, warp what is left, ask all of it."""

from typing import final

import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.kernels.backend import Backend, CellTables, Rays, Samples
from avatar.paper.emptiness import Emptiness
from avatar.paper.warp import Warp
from avatar.sampling import Sampler


@final
class PosedSampler:
    """Samples of the body frame that are not known to be empty, each warped on its own.

    No ray ends early: every sample up to the far wall of the person's box is there.
    """

    def __init__(self, backend: Backend, emptiness: Emptiness, warp: Warp, step_m: float) -> None:
        """A sampler.

        Args:
            backend: Places samples.
            emptiness: Where none need be.
            warp: Carries them to canonical space.
            step_m: Distance between samples along a ray, metres.
        """
        self._backend, self._emptiness = backend, emptiness
        self._warp, self._step_m = warp, step_m

    def samples(self, rays: Rays, cells: CellTables) -> Samples:
        """Canonical samples along rays; what has no canonical point is left out."""
        points, placed = self._backend.place(rays, self._emptiness.grid(cells), self._step_m)
        slots = rays.slots.repeat_interleave(placed)
        warped = self._warp(points, slots, cells)
        before = torch.nn.functional.pad(torch.cumsum(warped.found.int(), 0), (1, 0))
        last = torch.cumsum(placed, 0)
        first = before[last - placed]
        count = before[last] - first
        return Samples(warped.points, first, count.int(), warped.rows)

    def empty_points(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """What is known to be empty."""
        return self._emptiness.empty_points(count, generator)

    def solid_points(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """None: the paper asks nothing of them."""
        return torch.zeros(0, 3, device=generator.device)

    def gap_points(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """None, likewise."""
        return torch.zeros(0, 3, device=generator.device)

    def admit(self, slot: int, cells: CellTables, bones: Float32[Tensor, "24 12"]) -> None:
        """Both parts learn of the frame."""
        self._warp.admit(slot, bones)
        self._emptiness.admit(slot, cells)

    def update(self, steps: int, cells: CellTables, generator: torch.Generator) -> None:
        """Grids are renewed when it is time."""
        self._emptiness.update(steps, cells, generator)


@final
class GloballySparse:
    """Another sampler, but emptiness is asked for everywhere: the paper's Global Sparsity.

    The prior that the paper's Fig. 5 compares with: it biases the density of every point towards
    zero, the person's own included.
    """

    def __init__(
        self, sampler: Sampler, low: Float32[Tensor, "3"], high: Float32[Tensor, "3"]
    ) -> None:
        """Asks for emptiness anywhere in the box between two corners."""
        self._sampler, self._low, self._high = sampler, low, high

    def samples(self, rays: Rays, cells: CellTables) -> Samples:
        """The other's."""
        return self._sampler.samples(rays, cells)

    def empty_points(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Random points of the whole box."""
        place = torch.rand(count, 3, generator=generator, device=generator.device)
        return self._low + place.to(self._low.device) * (self._high - self._low)

    def solid_points(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """The other's."""
        return self._sampler.solid_points(count, generator)

    def gap_points(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """The other's."""
        return self._sampler.gap_points(count, generator)

    def admit(self, slot: int, cells: CellTables, bones: Float32[Tensor, "24 12"]) -> None:
        """The other learns of it."""
        self._sampler.admit(slot, cells, bones)

    def update(self, steps: int, cells: CellTables, generator: torch.Generator) -> None:
        """The other is renewed."""
        self._sampler.update(steps, cells, generator)

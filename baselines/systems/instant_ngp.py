"""Instant-NGP (Müller et al. 2022) without articulation: a hash grid in the body frame.

The person is taken for a rigid thing that only turns and moves as a whole. The grid and its
compiled kernels are the product's own, so that nothing but the articulation is missing.
"""

from typing import Any, final

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor, nn

from avatar.config import COARSEST_M, TrainConfig
from avatar.kernels import operations
from avatar.kernels.operands import MAX_LOG_DENSITY, FeatureGradients, HashLevels
from avatar.radiance_field import RadianceField
from avatar.training.trainer import NETWORK_RATE_FACTOR
from baselines.systems.method_settings import MethodSettings
from baselines.systems.posed_person import CELL_M, OccupiedCells, PosedBodies

MARGIN_M = 0.17
"""Margin of the box about all skins that were filmed, metres; the product's own."""
PROBE_INTERVAL = 16
"""Steps between updates of the occupied cells."""
PROBE_DECAY = 0.8
"""Decay of a cell's density between them."""
MIN_DENSITY = 0.5
"""Density above which a cell is occupied, 1/m; the fog of an untrained field is."""

PRESETS = {
    "paper": MethodSettings(frames=64, rays=4096, samples=128, learning_rate=2.5e-2),
    "small": MethodSettings(frames=16, rays=1024, samples=48, learning_rate=2.5e-2),
}


class _HashGridGradient(torch.autograd.Function):
    """The product's field, whose gradient is written by hand, as one operation of autograd."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, anchor: Tensor, field: RadianceField) -> Tensor:
        """The raw outputs; `anchor` only makes autograd come back here."""
        features, raw = operations.field_forward(points, field.table, field.levels, field.network)
        ctx.field, ctx.points, ctx.features = field, points, features
        return raw

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, Tensor, None]:
        """Writes the parameters' gradients."""
        field, features = ctx.field, ctx.features.requires_grad_()
        with torch.enable_grad():
            first, first_bias, second, second_bias = field.network
            raw = torch.relu(features @ first + first_bias) @ second + second_bias
        grad_features, *grads = torch.autograd.grad(raw, [features, *field.network], gradients[0])
        for parameter, grad in zip(field.layers, grads, strict=True):
            parameter.grad.copy_(grad)
        count = len(features)
        parts = FeatureGradients(np.arange(count), grad_features.numpy(), np.array([[0, count]]))
        operations.add_table_gradient(ctx.points, parts, field.levels, field.table_grad)
        return None, torch.zeros(()), None


@final
class InstantNgp(nn.Module):
    """The method: no warp at all, and cells that density has been found in."""

    def __init__(
        self,
        skins: Float32[Tensor, "bodies vertices 3"],
        settings: MethodSettings,
        config: TrainConfig,
    ) -> None:
        """An untrained grid with the product's levels, in the box of all skins that were filmed."""
        super().__init__()
        low, high = skins.amin(dim=(0, 1)) - MARGIN_M, skins.amax(dim=(0, 1)) + MARGIN_M
        levels = HashLevels.spanning(
            low.numpy(), high.numpy(), coarsest_m=COARSEST_M, finest_m=config.finest_m,
            levels=config.levels, table_size=config.table_size,
        )  # fmt: skip
        start = torch.Generator().manual_seed(config.seed)
        self.field = RadianceField(levels, start)
        self._anchor = torch.zeros((), requires_grad=True)
        self._low, self._shape = low, ((high - low) / CELL_M).ceil().long()
        self._density = torch.full((int(self._shape.prod()),), MIN_DENSITY)
        self._rate, self._poses = settings.learning_rate, 0

    def pose(self, bodies: PosedBodies) -> OccupiedCells:
        """Every body has the same cells."""
        count = len(bodies.frames)
        if self.training:
            if self._poses % PROBE_INTERVAL == 0:
                self._probe_cells()
            self._poses += 1
        grid = self._density.view(self._shape.tolist())
        occupied = nn.functional.max_pool3d(grid[None, None], 3, 1, 1)[0, 0] >= MIN_DENSITY
        return OccupiedCells(
            self._low.expand(count, 3), self._shape.expand(count, 3),
            torch.zeros(count, dtype=torch.int64), _never_empty(occupied.flatten()), CELL_M,
        )  # fmt: skip

    def _probe_cells(self) -> None:
        """Raises the cells' decayed densities to those at one random point of each."""
        x, y, z = (torch.arange(size) for size in self._shape.tolist())
        corner = torch.cartesian_prod(x, y, z)
        raw = self.field.raw_outputs_at(self._low + (corner + torch.rand(corner.shape)) * CELL_M)
        found = torch.exp(raw[:, 3].clamp(max=MAX_LOG_DENSITY))
        self._density = torch.maximum(PROBE_DECAY * self._density, found)

    def radiance(
        self, points: Float32[Tensor, "points 3"], directions: Float32[Tensor, "points 3"],
        bodies: Int64[Tensor, "points"], *, fine: bool,
    ) -> Float32[Tensor, "points 4"]:  # fmt: skip
        """The field at points of the body frame."""
        return _HashGridGradient.apply(points.contiguous(), self._anchor, self.field)

    def prior_loss(self) -> Tensor:
        """None."""
        return torch.zeros(())

    def parameter_groups(self) -> list[dict[str, object]]:
        """The table's rate, and the network's share of it, as in the product."""
        return [
            {"params": [self.field.table], "lr": self._rate, "eps": 1e-15},
            {"params": self.field.layers, "lr": self._rate * NETWORK_RATE_FACTOR},
        ]


def _never_empty(occupied: Bool[Tensor, "cells"]) -> Bool[Tensor, "cells"]:
    """All cells where a field has died, so that it can come back."""
    return occupied if occupied.any() else torch.ones_like(occupied)

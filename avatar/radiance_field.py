"""The canonical radiance field, and draws of the pairs of points at which its priors hold.

A hash grid and a small network, with a hand-written gradient.
"""

import copy
import math
from typing import final

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.config import TrainConfig
from avatar.kernels import numba_priors, operations
from avatar.kernels.operands import (
    FEATURES_PER_LEVEL,
    HIDDEN_WIDTH,
    HashLevels,
    LearntRays,
    NetworkLayers,
)

RawPoints = Float32[Tensor, "points 4"]
"""Log density and color of points, before their activations."""


@final
class RadianceField:
    """Color and density at canonical points, without view direction (InstantAvatar, §3.1).

    One network of `width → 64 → 4`: 2.8 times cheaper than the two of the paper's code. `layers`
    are the weights and biases of both layers; a frozen field takes no gradients.
    `gradient_strength` is the mean strength of the points' gradients in the last step.
    """

    is_frozen = False
    gradient_strength = 0.0

    def __init__(self, levels: HashLevels, generator: torch.Generator) -> None:
        """Draws the initial parameters from `generator`."""
        self.levels = levels

        def normal(rows: int, columns: int, spread: float) -> Tensor:
            return torch.randn(rows, columns, generator=generator) * spread

        table = (
            torch.rand(levels.entries, FEATURES_PER_LEVEL, generator=generator) * 2.0 - 1.0
        ) * 1e-2
        first = normal(levels.feature_width, HIDDEN_WIDTH, math.sqrt(2.0 / levels.feature_width))
        second = normal(HIDDEN_WIDTH, 4, math.sqrt(1.0 / HIDDEN_WIDTH))
        bias = torch.zeros(4)  # density 1 per metre, a fog thin enough to be cleared quickly
        self.table, *self.layers = (
            torch.nn.Parameter(values)
            for values in (table, first, torch.zeros(HIDDEN_WIDTH), second, bias)
        )
        for parameter in self.parameters():
            parameter.grad = torch.zeros_like(parameter)

    def clone(self) -> "RadianceField":
        """An independent copy of the field."""
        other = copy.copy(self)
        other.table, *other.layers = (
            torch.nn.Parameter(parameter.detach().clone()) for parameter in self.parameters()
        )
        for parameter in other.parameters():
            parameter.grad = torch.zeros_like(parameter)
        return other

    def frozen(self) -> "RadianceField":
        """The same field, without gradients of its parameters."""
        other = copy.copy(self)
        other.is_frozen = True
        return other

    def parameters(self) -> list[torch.nn.Parameter]:
        """The table, then weights and biases of both layers."""
        return [self.table, *self.layers]

    @property
    def network(self) -> NetworkLayers:
        """Weights and biases of both layers."""
        first, first_bias, second, second_bias = self.layers
        return first, first_bias, second, second_bias

    @property
    def table_grad(self) -> Float32[Tensor, "entries 4"]:
        """Gradient of the table, which accumulates until it is zeroed."""
        assert self.table.grad is not None, "the table's gradient is zeroed, never taken away"
        return self.table.grad

    @torch.no_grad()
    def add_gradients(self, learnt: LearntRays) -> None:
        """Takes the gradients of a pass: writes the network's, adds the table's; none if frozen."""
        if learnt.network is None:
            return
        for parameter, grad in zip(self.layers, learnt.network, strict=True):
            assert parameter.grad is not None, "a gradient is overwritten, never taken away"
            parameter.grad.numpy()[...] = grad
        operations.add_table_gradient(learnt.points, learnt.features, self.levels, self.table_grad)

    @torch.no_grad()
    def raw_outputs_at(self, points: Float32[Tensor, "points 3"]) -> RawPoints:
        """Raw outputs at any number of canonical points, in chunks."""
        chunks = [
            operations.field_forward(chunk, self.table, self.levels, self.network)[1]
            for chunk in points.split(1 << 13)  # a cache holds their features and hidden layer
        ]
        return torch.cat(chunks) if chunks else points.new_empty(0, 4)


TV_PAIR_SIGMA_M = 0.01
"""Standard deviation of the offset within a total-variation pair, metres per axis."""


def sample_tv_pairs(
    points: Float32[Tensor, "samples 3"], config: TrainConfig, seed: int
) -> Float32[Tensor, "points 3"]:
    """Random samples followed by one neighbor of each; empty if neither pair prior is on.

    The seed, below 2³², decides the draw.
    """
    count = config.density_tv_pairs if config.density_tv_weight or config.double_well_weight else 0
    return _sample_pairs(points, count, TV_PAIR_SIGMA_M, seed)


def sample_smoothness_pairs(
    points: Float32[Tensor, "samples 3"], config: TrainConfig, seed: int
) -> Float32[Tensor, "points 3"]:
    """Pairs about a finest cell apart, as `sample_tv_pairs`; empty if both weights are zero."""
    count = config.smoothness_pairs if config.density_slope_weight or config.color_tv_weight else 0
    return _sample_pairs(points, count, 0.5 * config.finest_m, seed)


def _sample_pairs(
    points: Float32[Tensor, "samples 3"], count: int, sigma_m: float, seed: int
) -> Float32[Tensor, "points 3"]:
    pairs = torch.empty(2 * count if len(points) else 0, 3)
    numba_priors.draw_pairs(np.uint32(seed), np.float32(sigma_m), points.numpy(), pairs.numpy())
    return pairs

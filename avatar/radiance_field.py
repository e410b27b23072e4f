"""The canonical radiance field, and its priors: empty off the body, solid inside, smooth.

A hash grid and a small network, with a hand-written gradient. The priors count where rays do not
determine the field. Most terms penalise the opacity of one centimetre, α = 1 - exp(-σ · 1 cm), as
in the paper's code, where s is the log density and dα/ds = σ · 1 cm · (1 - α). Each function
returns the gradient of a mean over points with respect to the raw outputs.
"""

import copy
import math
from collections.abc import Callable
from typing import NamedTuple, final

import numpy as np
import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from avatar.config import TrainConfig
from avatar.kernels import numba_priors, operations
from avatar.kernels.operands import FEATURES_PER_LEVEL, HIDDEN_WIDTH, HashLevels, NetworkLayers

RawPoints = Float32[Tensor, "points 4"]
"""Log density and color of points, before their activations."""
INITIAL_LOG_DENSITY = 0.0
"""Raw density of an untrained field: 1 per metre, a fog thin enough to be cleared quickly."""
POINTS_PER_CHUNK = 1 << 13
"""Points per chunk, whose features and hidden layer fit into a cache."""


class Activations(NamedTuple):
    """Values of the forward pass that the backward pass needs."""

    points: Float32[Tensor, "points 3"]
    features: Float32[Tensor, "points width"]
    raw: RawPoints


@final
class RadianceField:
    """Color and density at canonical points, without view direction (InstantAvatar, §3.1).

    One network of `width → 64 → 4`: 2.8 times cheaper than the two of the paper's code. `layers`
    are the weights and biases of both layers; `backward` of a frozen field leaves their gradients
    out.
    """

    is_frozen = False

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
        bias = torch.tensor([0.0, 0.0, 0.0, INITIAL_LOG_DENSITY])
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
    def forward(self, points: Float32[Tensor, "points 3"]) -> Activations:
        """Raw outputs at canonical points, and what their gradient will need."""
        return Activations(
            points, *operations.field_forward(points, self.table, self.levels, self.network)
        )

    @torch.no_grad()
    def backward(
        self,
        activations: Activations,
        grad_raw: Float32[Tensor, "some 4"],
        rows: Int64[Tensor, "some"] | None = None,
    ) -> Float32[Tensor, "some width"]:
        """Writes the gradient of every parameter (the table's is added), unless it is frozen.

        `grad_raw` is the gradient of the outputs of the points in `rows`, all points if None; the
        others have none. Returns the gradient of these points' features.
        """
        points, features, _ = activations
        rows = torch.arange(len(points)) if rows is None else rows
        grad_features, grads = operations.network_backward(
            features, rows, grad_raw, self.network, is_frozen=self.is_frozen
        )
        if grads is None:
            return grad_features
        for parameter, grad in zip(self.layers, grads, strict=True):
            assert parameter.grad is not None, "a gradient is overwritten, never taken away"
            parameter.grad.copy_(grad)
        operations.encode_backward(points, rows, grad_features, self.levels, self.table_grad)
        return grad_features

    @torch.no_grad()
    def raw_outputs_at(self, points: Float32[Tensor, "points 3"]) -> RawPoints:
        """Raw outputs at any number of canonical points, in chunks."""
        chunks = [self.forward(chunk).raw for chunk in points.split(POINTS_PER_CHUNK)]
        return torch.cat(chunks) if chunks else points.new_empty(0, 4)


TV_PAIR_SIGMA_M = 0.01
"""Standard deviation of the offset within a total-variation pair, metres per axis."""
MIN_OPACITY = 1e-6
"""Opacity below which the interior loss's logarithm is clamped."""
SMOOTHNESS_PAIR_SIGMA_CELLS = 0.5
"""Standard deviation of the offset within a smoothness pair, in finest cells per axis."""
MAX_USEFUL_LOG_DENSITY = 6.0
"""Log density above which density is excess (400 per metre: opacity 0.5 in two millimetres)."""
EXCESS_DENSITY_FACTOR = 0.4
"""Weight of excess density relative to the slope penalty."""
SOURCE_STEEPNESS = 3.0
"""Factor of a source's opacity about one half."""
VISIBLE_LOG_DENSITY = 2.0
"""Log density from which one point of a pair makes the pair's colors visible."""


def _gradient(
    add: Callable[..., None], raw: RawPoints, *arguments: Float32[np.ndarray, "..."] | float
) -> RawPoints:
    """What a kernel of `numba_priors` adds to zeros."""
    grad = torch.zeros_like(raw)
    add(raw.numpy(), *(np.float32(argument) for argument in arguments), grad.numpy())
    return grad


def empty_space_gradient(raw: RawPoints, weight: float) -> RawPoints:
    """Gradient of the mean α in space that should be empty (the paper's §3.4)."""
    return _gradient(numba_priors.empty_space, raw, weight)


def interior_gradient(raw: RawPoints, weight: float) -> RawPoints:
    """Gradient of the mean -log α in the interior; cross-entropy acts at zero opacity as well."""
    return _gradient(numba_priors.interior, raw, weight, MIN_OPACITY)


def log_density_l1_gradient(raw: RawPoints, weight: float) -> RawPoints:
    """Gradient of the mean log density where it is above 0.

    Density that a ray needs withstands the small gradient; under Adam, density that no ray needs
    vanishes however small the gradient is.
    """
    return _gradient(numba_priors.log_density_l1, raw, weight)


def sample_tv_pairs(
    points: Float32[Tensor, "samples 3"], config: TrainConfig, generator: torch.Generator
) -> Float32[Tensor, "points 3"]:
    """Random samples followed by one neighbor of each; empty if neither pair prior is on."""
    count = config.density_tv_pairs if config.density_tv_weight or config.double_well_weight else 0
    return _sample_pairs(points, count, TV_PAIR_SIGMA_M, generator)


def sample_smoothness_pairs(
    points: Float32[Tensor, "samples 3"], config: TrainConfig, generator: torch.Generator
) -> Float32[Tensor, "points 3"]:
    """Pairs about a finest cell apart, as `sample_tv_pairs`; empty if both weights are zero."""
    count = config.smoothness_pairs if config.density_slope_weight or config.color_tv_weight else 0
    return _sample_pairs(points, count, SMOOTHNESS_PAIR_SIGMA_CELLS * config.finest_m, generator)


def _sample_pairs(
    points: Float32[Tensor, "samples 3"], count: int, sigma_m: float, generator: torch.Generator
) -> Float32[Tensor, "points 3"]:
    count = count if len(points) else 0
    chances = torch.rand(count, generator=generator)
    apart = sigma_m * torch.randn(count, 3, generator=generator)
    pairs = torch.empty(2 * count, 3)
    numba_priors.draw_pairs(chances.numpy(), apart.numpy(), points.numpy(), pairs.numpy())
    return pairs


def density_tv_gradient(raw: RawPoints, weight: float) -> RawPoints:
    """Gradient of the mean |α - α'| over pairs of points.

    The total variation of a solid is its surface area (Rudin, Osher and Fatemi 1992); of all
    surfaces that explain the images it prefers the smallest, which is the smoothest. It does not
    penalise sharp edges, but it does not penalise thick, half-transparent layers either. `raw` has
    the first points of the pairs, then the second.
    """
    return _gradient(numba_priors.density_tv, raw, weight)


def double_well_gradient(raw: RawPoints, weight: float) -> RawPoints:
    """Gradient of the mean α (1 - α), which vanishes where space is opaque or empty.

    Together with the total variation it minimises fog and surface area, as between two phases of a
    fluid (Modica and Mortola 1977).
    """
    return _gradient(numba_priors.double_well, raw, weight)


def density_slope_gradient(
    raw: RawPoints, points: Float32[Tensor, "points 3"], max_slope_per_m: float, weight: float
) -> RawPoints:
    """Gradient of the mean of max(0, |s - s'| - k · |x - x'|), and of density in excess.

    A few images in slightly wrong poses are explained as well by a razor-sharp surface that is
    rough between pixels. Neither the renderer's samples nor the player's voxels can represent it: a
    shift of the samples by half a step changed the image by 38 dB. Density above
    `MAX_USEFUL_LOG_DENSITY` is penalised too, since it only steepens the edge. Pairs are as in
    `density_tv_gradient`; k is `max_slope_per_m`.
    """
    return _gradient(
        numba_priors.density_slope, raw, points.numpy(), max_slope_per_m, MAX_USEFUL_LOG_DENSITY,
        EXCESS_DENSITY_FACTOR, weight,
    )  # fmt: skip


def color_tv_gradient(raw: RawPoints, weight: float) -> RawPoints:
    """Gradient of the mean |c - c'| of visible pairs, as in `density_tv_gradient`."""
    return _gradient(numba_priors.color_tv, raw, VISIBLE_LOG_DENSITY, weight)


def source_gradient(raw: RawPoints, weights: Float32[Tensor, "pairs"], weight: float) -> RawPoints:
    """Gradient of the cross-entropy of points to their sources, in opacity and in color.

    Cross-entropy acts where a point is empty and its source is not, too. The sources stand still.
    Their opacity is steepened about one half, so that the copy of a soft surface is firm; their
    color counts as far as they are opaque. `raw` has the points, then their sources; `weights` are
    the pairs' own, in [0, 1].
    """
    return _gradient(numba_priors.toward_sources, raw, weights.numpy(), weight, SOURCE_STEEPNESS)

"""What a field is asked to be where no ray tells: empty off the body, solid in it, firm, smooth.

Most terms speak of the opacity of one centimetre, α = 1 - exp(-σ · 1 cm), as in the paper's code,
and of log density s; dα/ds = σ · 1 cm · (1 - α). Each function gives the gradient of a mean.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.config import TrainConfig
from avatar.kernels.torch_reference import MAX_LOG_DENSITY

OPACITY_LENGTH_M = 0.01
TV_PAIR_SIGMA_M = 0.01
"""Standard deviation of the way from one point of a pair to the other, along each axis."""
MIN_OPACITY = 1e-6
SMOOTHNESS_PAIR_SIGMA_CELLS = 0.5
"""Standard deviation of the way between close points, in finest cells."""
MAX_USEFUL_LOG_DENSITY = 6.0
"""Nothing needs more density than this (400 per metre: one half within two millimetres)."""
EXCESS_DENSITY_FACTOR = 0.4
"""How much more density counts, beside steepness."""
VISIBLE_LOG_DENSITY = 2.0
"""Colors count where one of two points is denser than this."""


class OpacityWithSlope(NamedTuple):
    """Opacity of one centimetre and its slope over log density."""

    value: Float32[Tensor, "points"]
    slope: Float32[Tensor, "points"]

    @classmethod
    def of(cls, raw: Float32[Tensor, "points 4"]) -> "OpacityWithSlope":
        """From a field's raw numbers."""
        optical = torch.exp(raw[:, 3].clamp(max=MAX_LOG_DENSITY)) * OPACITY_LENGTH_M
        through = torch.exp(-optical)
        return cls(1.0 - through, optical * through)


def empty_space_gradient(
    raw: Float32[Tensor, "points 4"], weight: float
) -> Float32[Tensor, "points 4"]:
    """Of the mean α where nothing should be (the paper's §3.4)."""
    return _log_density_only(raw, weight / max(len(raw), 1) * OpacityWithSlope.of(raw).slope)


def interior_gradient(
    raw: Float32[Tensor, "points 4"], weight: float
) -> Float32[Tensor, "points 4"]:
    """Of the mean -log α where something must be: cross-entropy, which pulls at nothing, too."""
    opacity = OpacityWithSlope.of(raw)
    slope = opacity.slope / opacity.value.clamp(min=MIN_OPACITY)
    return _log_density_only(raw, -weight / max(len(raw), 1) * slope)


def log_density_l1_gradient(
    raw: Float32[Tensor, "points 4"], weight: float
) -> Float32[Tensor, "points 4"]:
    """Of the mean log density where that is above 0: what is solid is pulled at, too.

    What a ray needs it holds against a weak pull; under Adam what none needs goes, however weak.
    """
    return _log_density_only(raw, weight / max(len(raw), 1) * (raw[:, 3] > 0.0))


def sample_tv_pairs(
    points: Float32[Tensor, "samples 3"], config: TrainConfig, generator: torch.Generator
) -> Float32[Tensor, "points 3"]:
    """Samples drawn at random, and after them a point near each: none if there is no weight."""
    count = config.density_tv_pairs if config.density_tv_weight else 0
    return _sample_pairs(points, count, TV_PAIR_SIGMA_M, generator)


def sample_smoothness_pairs(
    points: Float32[Tensor, "samples 3"], config: TrainConfig, generator: torch.Generator
) -> Float32[Tensor, "points 3"]:
    """The same, about a finest cell apart: none where nothing is asked of them."""
    count = config.smoothness_pairs if config.density_slope_weight or config.color_tv_weight else 0
    return _sample_pairs(points, count, SMOOTHNESS_PAIR_SIGMA_CELLS * config.finest_m, generator)


def _sample_pairs(
    points: Float32[Tensor, "samples 3"], count: int, sigma_m: float, generator: torch.Generator
) -> Float32[Tensor, "points 3"]:
    size = (count if len(points) else 0, 3)
    chosen = torch.randint(
        max(len(points), 1), size[:1], generator=generator, device=generator.device
    )
    apart = sigma_m * torch.randn(size, generator=generator, device=generator.device)
    first = points[chosen.to(points.device)]
    return torch.cat([first, first + apart.to(points)])


def density_tv_gradient(
    raw: Float32[Tensor, "points 4"], weight: float
) -> Float32[Tensor, "points 4"]:
    """Of the mean |α - α'| over pairs of points.

    The total variation of a solid is its surface (Rudin, Osher and Fatemi 1992), and of all
    surfaces that explain the pictures the smallest is the least ragged one. An edge may be as sharp
    as it likes; but of what a ray needs not one half as opaque and twice as thick is as good.

    Args:
        raw: First points of the pairs, then second ones.
        weight: Of the term.
    """
    count, opacity = len(raw) // 2, OpacityWithSlope.of(raw)
    sign = torch.sign(opacity.value[:count] - opacity.value[count:])
    return _log_density_only(raw, weight / max(count, 1) * torch.cat([sign, -sign]) * opacity.slope)


def double_well_gradient(
    raw: Float32[Tensor, "points 4"], weight: float
) -> Float32[Tensor, "points 4"]:
    """Of the mean α (1 - α), which is least where all is solid or nothing.

    With total variation beside it the least fog and the smallest surface are sought together, as
    between two phases of a fluid (Modica and Mortola 1977).
    """
    opacity = OpacityWithSlope.of(raw)
    return _log_density_only(
        raw, weight / max(len(raw), 1) * (1.0 - 2.0 * opacity.value) * opacity.slope
    )


def density_slope_gradient(
    raw: Float32[Tensor, "points 4"],
    points: Float32[Tensor, "points 3"],
    max_slope_per_m: float,
    weight: float,
) -> Float32[Tensor, "points 4"]:
    """Of the mean by which log density changes too fast, |s - s'| - k · |x - x'| where that is > 0.

    Few pictures in poses that are a little off are explained as well by a surface with a razor's
    edge, rough between one pixel and the next. Such an edge neither the renderer's samples nor the
    player's voxels can show: half a step's shift of the samples changed the picture by 38 dB.
    Density beyond `MAX_USEFUL_LOG_DENSITY` is asked to fall, too: it only steepens.

    Args:
        raw: First points of the pairs, then second ones.
        points: Where they are, metres.
        steepest_per_m: k.
        weight: Of the term.
    """
    count, logs = len(raw) // 2, raw[:, 3]
    change = logs[:count] - logs[count:]
    allowed = max_slope_per_m * (points[:count] - points[count:]).norm(dim=1)
    seen = torch.maximum(logs[:count], logs[count:]) > 0.0
    pull = torch.sign(change) * (seen & (change.abs() > allowed)) / max(count, 1)
    needless = EXCESS_DENSITY_FACTOR / max(len(raw), 1) * (logs > MAX_USEFUL_LOG_DENSITY)
    return _log_density_only(raw, weight * (torch.cat([pull, -pull]) + needless))


def color_tv_gradient(
    raw: Float32[Tensor, "points 4"], weight: float
) -> Float32[Tensor, "points 4"]:
    """Of the mean |c - c'| of visible pairs, summed over channels.

    Args:
        raw: First points of the pairs, then second ones.
        weight: Of the term.
    """
    count, color = len(raw) // 2, torch.sigmoid(raw[:, :3])
    seen = torch.maximum(raw[:count, 3:], raw[count:, 3:]) > VISIBLE_LOG_DENSITY
    pull = weight / max(count, 1) * seen * torch.sign(color[:count] - color[count:])
    grad = torch.zeros_like(raw)
    grad[:, :3] = torch.cat([pull, -pull]) * color * (1.0 - color)
    return grad


def _log_density_only(
    raw: Float32[Tensor, "points 4"], slope: Float32[Tensor, "points"]
) -> Float32[Tensor, "points 4"]:
    """No gradient for colours."""
    grad = torch.zeros_like(raw)
    grad[:, 3] = slope
    return grad

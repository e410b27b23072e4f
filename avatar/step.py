"""One training step: the only place where the operations meet, without autograd."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float32, Int32
from torch import Tensor

from avatar.config import TrainConfig
from avatar.field import Field
from avatar.kernels.backend import CellTables, Grid, Samples
from avatar.kernels.reference import MAX_LOG_DENSITY
from avatar.refine import PULLING_M, PoseTable
from avatar.replay import Batch
from avatar.sampling import Sampler

OPACITY_M = 0.01
"""Emptiness and variation are those of the opacity of one centimetre, as in the paper's code."""
APART_M = 0.01
"""Standard deviation of the way from one point of a pair to the other, along each axis."""


class StepResult(NamedTuple):
    """What a step tells.

    Attributes:
        loss: Of each ray.
        samples: How many samples its rays had.
    """

    loss: Float32[Tensor, "rays"]
    samples: int


@torch.no_grad()
def gradients(
    field: Field,
    sampler: Sampler,
    cells: CellTables,
    batch: Batch,
    config: TrainConfig,
    *,
    hard_share: float,
    remember: Grid | None = None,
    poses: PoseTable | None = None,
    generator: torch.Generator,
) -> StepResult:
    """Renders a batch and leaves the gradient of its mean loss in the field's parameters.

    Args:
        field: What is learnt.
        sampler: Where samples lie.
        cells: Warp cells of the frames that the batch's slots name.
        batch: Rays and what the video shows along them.
        config: The recipe.
        hard_share: Share of the hard-surface loss's weight, in [0, 1]: it grows in, for a surface
            must be found before it can be hard.
        remember: Whose cached densities the samples' raise, if any.
        poses: Whose wrenches take up what pulls the samples, if poses are refined.
        generator: Of backgrounds, empty points and pairs, on the field's device.
    """
    samples = sampler.samples(batch.rays, cells)
    empty = (
        sampler.empty_points(config.empty_points, generator).to(samples.points)
        if config.empty_weight
        else samples.points[:0]
    )
    pairs = _pairs(samples.points, config, generator)
    seen = field.forward(torch.cat([samples.points, empty, pairs]))
    count, until = len(samples.points), len(samples.points) + len(empty)
    background = torch.rand(len(batch.target), 3, generator=generator, device=generator.device)
    _, loss, grad = field.backend.composite_loss(
        seen.raw[:count], samples, config.step_m, batch.target, background,
        config.alpha_weight, config.hard_weight * hard_share,
    )  # fmt: skip
    grad_empty = _grad_of_emptiness(seen.raw[count:until], config.empty_weight)
    grad_pairs = _grad_of_variation(seen.raw[until:], config.variation_weight)
    grad_features = field.backward(seen, torch.cat([grad, grad_empty, grad_pairs]))
    if poses is not None and count:
        _pull(poses, field, samples, grad_features[:count], batch.rays.slots, cells, loss)
    if remember is not None:
        log_density = seen.raw[:count, 3].contiguous()
        field.backend.keep_highest(seen.points[:count], log_density, remember)
    return StepResult(loss, count)


def _grad_of_emptiness(raw: Float32[Tensor, "points 4"], weight: float) -> Tensor:
    """Gradient of the mean opacity of one centimetre, 1 - exp(-σ · 1 cm) (the paper's §3.4)."""
    grad = torch.zeros_like(raw)
    grad[:, 3] = weight / max(len(raw), 1) * _opacity(raw).slope
    return grad


def _pairs(
    points: Float32[Tensor, "samples 3"], config: TrainConfig, generator: torch.Generator
) -> Float32[Tensor, "points 3"]:
    """Samples drawn at random, and after them a point near each: none if there is no weight."""
    count = config.variation_pairs if config.variation_weight and len(points) else 0
    size = (count, 3)
    chosen = torch.randint(
        max(len(points), 1), size[:1], generator=generator, device=generator.device
    )
    apart = APART_M * torch.randn(size, generator=generator, device=generator.device)
    first = points[chosen.to(points.device)]
    return torch.cat([first, first + apart.to(points)])


def _grad_of_variation(raw: Float32[Tensor, "points 4"], weight: float) -> Tensor:
    """Gradient of the mean |α - α'| over pairs of points, α the opacity of one centimetre.

    The total variation of a solid is its surface (Rudin, Osher and Fatemi 1992), and of all
    surfaces that explain the pictures the smallest is the least ragged one. An edge may be as sharp
    as it likes.

    Args:
        raw: First points of the pairs, then second ones.
        weight: Of the term.
    """
    grad, count = torch.zeros_like(raw), len(raw) // 2
    opacity = _opacity(raw)
    sign = torch.sign(opacity.value[:count] - opacity.value[count:])
    grad[:, 3] = weight / max(count, 1) * torch.cat([sign, -sign]) * opacity.slope
    return grad


class _Opacity(NamedTuple):
    """Opacity of one centimetre, 1 - exp(-σ · 1 cm), and its slope over log density."""

    value: Float32[Tensor, "points"]
    slope: Float32[Tensor, "points"]


def _opacity(raw: Float32[Tensor, "points 4"]) -> _Opacity:
    optical = torch.exp(raw[:, 3].clamp(max=MAX_LOG_DENSITY)) * OPACITY_M
    through = torch.exp(-optical)
    return _Opacity(1.0 - through, optical * through)


def _pull(
    poses: PoseTable,
    field: Field,
    samples: Samples,
    grad_features: Float32[Tensor, "samples width"],
    slots: Int32[Tensor, "rays"],
    cells: CellTables,
    loss: Float32[Tensor, "rays"],
) -> None:
    """Lets the samples pull at the poses that they were warped with."""
    backend, levels = field.backend, field.levels.no_finer_than(PULLING_M)
    each = grad_features[:, : levels.width] * len(loss)  # of each ray's own loss, not of the mean
    grad_points = backend.encode_points_backward(samples.points, each, field.table, levels)
    wrenches = backend.wrenches(samples, grad_points, slots, cells, poses.skin, poses.bones)
    poses.feel(slots.long(), wrenches, loss)


def cosine(progress: float) -> float:
    """The learning rate's factor: 1 at progress 0, 0.05 at 1."""
    return max(0.05, 0.5 * (1.0 + math.cos(math.pi * min(max(progress, 0.0), 1.0))))

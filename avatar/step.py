"""One training step: the only place where the operations meet, without autograd."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float32, Int32
from torch import Tensor

from avatar import priors
from avatar.config import TrainConfig
from avatar.field import Field
from avatar.kernels.backend import CellTables, Grid, Samples
from avatar.refine import PULLING_M, PoseTable
from avatar.replay import Batch
from avatar.sampling import Sampler


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
    firm_share: float = 0.0,
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
        firm_share: How far, in [0, 1], surfaces have come from being found (smooth, and fog where
            poses do not agree yet) to being firm.
        remember: Whose cached densities the samples' raise, if any.
        poses: Whose wrenches take up what pulls the samples, if poses are refined.
        generator: Of backgrounds and of the points that are asked, on the field's device.
    """
    samples = sampler.samples(batch.rays, cells)
    asked = _asked(sampler, samples.points, config, generator)
    seen = field.forward(torch.cat([samples.points, *asked]))
    raw, *raw_asked = seen.raw.split([len(points) for points in (samples.points, *asked)])
    count = len(raw)
    background = torch.rand(len(batch.target), 3, generator=generator, device=generator.device)
    _, loss, grad = field.backend.composite_loss(
        raw, samples, config.step_m, batch.target, background,
        config.alpha_weight, config.hard_weight * hard_share,
    )  # fmt: skip
    grads = [grad, *_grads_asked(raw_asked, asked, config, firm_share)]
    grad_features = field.backward(seen, torch.cat(grads))
    if poses is not None and count:
        _pull(poses, field, samples, grad_features[:count], batch.rays.slots, cells, loss)
    if remember is not None:
        log_density = raw[:, 3].contiguous()
        field.backend.keep_highest(seen.points[:count], log_density, remember)
    return StepResult(loss, count)


def _asked(
    sampler: Sampler,
    points: Float32[Tensor, "samples 3"],
    config: TrainConfig,
    generator: torch.Generator,
) -> list[Float32[Tensor, "_ 3"]]:
    """Points that are asked besides the rays': empty, pairs, solid, close pairs, gaps."""
    none = points[:0]
    return [
        sampler.empty_points(config.empty_points, generator).to(points)
        if config.empty_weight
        else none,
        priors.pairs(points, config, generator),
        sampler.solid_points(config.solid_points, generator).to(points)
        if config.solid_weight
        else none,
        priors.close_pairs(points, config, generator),
        sampler.gap_points(config.gap_points, generator).to(points) if config.gap_weight else none,
    ]


def _grads_asked(
    raw: list[Float32[Tensor, "_ 4"]],
    points: list[Float32[Tensor, "_ 3"]],
    config: TrainConfig,
    firm_share: float,
) -> list[Float32[Tensor, "_ 4"]]:
    """The gradients of what `_asked` asks, in its order."""
    empty, pairs, solid, close, gaps = raw
    grad_pairs = priors.variation(pairs, config.variation_at(firm_share))
    if config.firm_weight:
        grad_pairs += priors.double_well(pairs, config.firm_weight * firm_share)
    grad_close = priors.steepness(
        close, points[3], config.steepest_per_m, config.soft_weight * firm_share
    )
    grad_close += priors.unevenness(close, config.even_weight * firm_share)
    return [
        priors.emptiness(empty, config.empty_weight),
        grad_pairs,
        priors.solidity(solid, config.solid_weight),
        grad_close,
        priors.needlessness(gaps, config.gap_weight),
    ]


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

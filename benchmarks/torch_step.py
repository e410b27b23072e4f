"""A training step in plain torch with autograd, on samples that are given."""

import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.config import TrainConfig
from avatar.field import RadianceField
from avatar.kernels import reference
from avatar.kernels.backend import RaySamples
from avatar.levels import HashLevels
from avatar.priors import OPACITY_LENGTH_M
from avatar.replay import TrainingBatch


class AutogradField:
    """A field's parameters, and its forward pass as autograd sees it."""

    def __init__(self, field: RadianceField) -> None:
        self.levels: HashLevels = field.levels
        self.parameters = [p.detach().clone().requires_grad_() for p in field.parameters()]

    def raw_outputs_at(self, points: Float32[Tensor, "points 3"]) -> Float32[Tensor, "points 4"]:
        table, first, first_bias, second, second_bias = self.parameters
        features = reference.encode(points, table, self.levels)
        return torch.relu(features @ first + first_bias) @ second + second_bias


def centimeter_opacity(raw: Float32[Tensor, "points 4"]) -> Float32[Tensor, "points"]:
    """OpacityWithSlope of one centimetre."""
    density = torch.exp(raw[:, 3].clamp(max=reference.MAX_LOG_DENSITY))
    return 1.0 - torch.exp(-density * OPACITY_LENGTH_M)


def autograd_step(
    field: AutogradField,
    samples: RaySamples,
    empty: Float32[Tensor, "empty 3"],
    pairs: Float32[Tensor, "pairs 3"],
    batch: TrainingBatch,
    background: Float32[Tensor, "rays 3"],
    config: TrainConfig,
) -> tuple[Tensor, ...]:
    """Gradients of the loss with respect to the field's parameters, by what the recipe asks."""
    asked = [samples.points, empty, pairs]
    raw, raw_empty, raw_pairs = field.raw_outputs_at(torch.cat(asked)).split([len(some) for some in asked])
    rendered = reference.composite(raw, samples.offsets, samples.counts, config.sample_step_m)
    loss = reference.loss_per_ray(
        rendered, batch.target, background, config.alpha_weight, config.hard_surface_weight
    ).mean()
    one, other = centimeter_opacity(raw_pairs).chunk(2)
    total = loss + config.empty_space_weight * centimeter_opacity(raw_empty).mean()
    total = total + config.density_tv_weight * (one - other).abs().mean()
    return torch.autograd.grad(total, field.parameters)

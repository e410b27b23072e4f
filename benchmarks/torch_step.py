"""A training step in plain torch with autograd, on samples that are given."""

import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.config import TrainConfig
from avatar.field import Field
from avatar.kernels import reference
from avatar.kernels.backend import Samples
from avatar.levels import HashLevels
from avatar.priors import OPACITY_M
from avatar.replay import Batch


class TorchField:
    """A field's parameters, and its forward pass as autograd sees it."""

    def __init__(self, field: Field) -> None:
        self.levels: HashLevels = field.levels
        self.parameters = [p.detach().clone().requires_grad_() for p in field.parameters()]

    def raw_at(self, points: Float32[Tensor, "points 3"]) -> Float32[Tensor, "points 4"]:
        table, first, first_bias, second, second_bias = self.parameters
        features = reference.encode(points, table, self.levels)
        return torch.relu(features @ first + first_bias) @ second + second_bias


def opacity_of(raw: Float32[Tensor, "points 4"]) -> Float32[Tensor, "points"]:
    """Opacity of one centimetre."""
    density = torch.exp(raw[:, 3].clamp(max=reference.MAX_LOG_DENSITY))
    return 1.0 - torch.exp(-density * OPACITY_M)


def torch_step(
    field: TorchField,
    samples: Samples,
    empty: Float32[Tensor, "empty 3"],
    pairs: Float32[Tensor, "pairs 3"],
    batch: Batch,
    background: Float32[Tensor, "rays 3"],
    config: TrainConfig,
) -> tuple[Tensor, ...]:
    """Gradients of the loss with respect to the field's parameters, by what the recipe asks."""
    asked = [samples.points, empty, pairs]
    raw, raw_empty, raw_pairs = field.raw_at(torch.cat(asked)).split([len(some) for some in asked])
    rendered = reference.composite(raw, samples.first, samples.count, config.step_m)
    loss = reference.loss_per_ray(
        rendered, batch.target, background, config.alpha_weight, config.hard_weight
    ).mean()
    one, other = opacity_of(raw_pairs).chunk(2)
    total = loss + config.empty_weight * opacity_of(raw_empty).mean()
    total = total + config.variation_weight * (one - other).abs().mean()
    return torch.autograd.grad(total, field.parameters)

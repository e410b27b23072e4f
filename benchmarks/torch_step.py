"""A training step in plain torch with autograd, on samples that are given."""

import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.config import TrainConfig
from avatar.field import Field
from avatar.kernels import reference
from avatar.kernels.backend import Samples
from avatar.levels import HashLevels
from avatar.replay import Batch
from avatar.step import OPACITY_M


class TorchField:
    """A field's parameters, and its forward pass as autograd sees it."""

    def __init__(self, field: Field) -> None:
        self.levels: HashLevels = field.levels
        self.parameters = [p.detach().clone().requires_grad_() for p in field.parameters()]

    def raw_at(self, points: Float32[Tensor, "points 3"]) -> Float32[Tensor, "points 4"]:
        table, first, first_bias, second, second_bias = self.parameters
        features = reference.encode(points, table, self.levels)
        return torch.relu(features @ first + first_bias) @ second + second_bias


def opacity_of(raw: Float32[Tensor, "points 4"]) -> Tensor:
    """Mean opacity of one centimetre at points that should be empty."""
    density = torch.exp(raw[:, 3].clamp(max=reference.MAX_LOG_DENSITY))
    return (1.0 - torch.exp(-density * OPACITY_M)).mean()


def torch_step(
    field: TorchField,
    samples: Samples,
    empty: Float32[Tensor, "empty 3"],
    batch: Batch,
    background: Float32[Tensor, "rays 3"],
    config: TrainConfig,
) -> tuple[Tensor, ...]:
    """Gradients of the loss with respect to the field's parameters."""
    raw = field.raw_at(torch.cat([samples.points, empty]))
    count = len(samples.points)
    rendered = reference.composite(raw[:count], samples.first, samples.count, config.step_m)
    loss = reference.loss_per_ray(
        rendered, batch.target, background, config.alpha_weight, config.hard_weight
    ).mean()
    total = loss + config.empty_weight * opacity_of(raw[count:])
    return torch.autograd.grad(total, field.parameters)

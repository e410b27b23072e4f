"""One step and the encoding alone: ours, and plain torch with autograd on the same samples."""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.config import TrainConfig
from avatar.kernels import operations
from avatar.kernels.numba_priors import OPACITY_LENGTH_M
from avatar.kernels.operands import EMPTY_SPACE, HashLevels, MarchSettings, RaySamples
from avatar.radiance_field import RadianceField, sample_tv_pairs
from avatar.training.replay_buffer import ReplayBuffer, TrainingBatch
from avatar.training.training_step import compute_gradients
from baselines import torch_reference
from benchmarks.measurements import Measurement
from benchmarks.sample_training import LoadedTrainer
from benchmarks.stopwatch import time_interleaved


class AutogradField:
    """A field's parameters, and its forward pass as autograd sees it."""

    def __init__(self, field: RadianceField) -> None:
        """Copies the parameters of `field`."""
        self.levels: HashLevels = field.levels
        self.parameters = [p.detach().clone().requires_grad_() for p in field.parameters()]

    def raw_outputs_at(self, points: Float32[Tensor, "points 3"]) -> Float32[Tensor, "points 4"]:
        """Raw outputs at canonical points."""
        table, first, first_bias, second, second_bias = self.parameters
        features = torch_reference.encode(points, table, self.levels)
        return torch.relu(features @ first + first_bias) @ second + second_bias


def centimeter_opacity(raw: Float32[Tensor, "points 4"]) -> Float32[Tensor, "points"]:
    """Opacity of one centimetre."""
    density = torch.exp(raw[:, 3].clamp(max=torch_reference.MAX_LOG_DENSITY))
    return 1.0 - torch.exp(-density * OPACITY_LENGTH_M)


def autograd_step(
    field: AutogradField,
    samples: RaySamples,
    empty: Float32[Tensor, "empty 3"],
    pairs: Float32[Tensor, "pairs 3"],
    batch: TrainingBatch,
    config: TrainConfig,
) -> tuple[Tensor, ...]:
    """Gradients of the loss with respect to the field's parameters, by what the recipe asks."""
    asked = [samples.points, empty, pairs]
    raw, raw_empty, raw_pairs = field.raw_outputs_at(torch.cat(asked)).split(
        [len(some) for some in asked]
    )
    rendered = torch_reference.composite(raw, samples.offsets, samples.counts, config.sample_step_m)
    loss = torch_reference.loss_per_ray(
        rendered, batch.target, config.alpha_weight, config.hard_surface_weight
    ).mean()
    one, other = centimeter_opacity(raw_pairs).chunk(2)
    total = loss + config.empty_space_weight * centimeter_opacity(raw_empty).mean()
    total = total + config.density_tv_weight * (one - other).abs().mean()
    return torch.autograd.grad(total, field.parameters)


def step_marks(seen: LoadedTrainer) -> list[Measurement]:
    """The step on 1,024 rays of one frame, by both."""
    trainer, config = seen.trainer, seen.trainer.config
    avatar, field = trainer.avatar, trainer.avatar.field
    frame = seen.frames[len(seen.frames) // 3]
    replay = ReplayBuffer(1)
    replay.add(frame)
    batch = replay.sample_rays(config.rays, _seeded())
    how = MarchSettings(config.sample_step_m, config.opaque_margin_m, config.max_samples)
    grid = avatar.occupancy.density_grid
    samples = operations.march(batch.rays, replay.correspondences, grid, how)
    chance = _seeded()
    empty = avatar.occupancy.sample(EMPTY_SPACE, config.empty_space_points, chance)
    near = sample_tv_pairs(samples.points, config, 1)
    plain = AutogradField(field)

    def ours(config: TrainConfig = config) -> None:
        field.table_grad.zero_()
        compute_gradients(
            avatar, replay.correspondences, batch, config,
            hard_surface_share=1.0, generator=_seeded(),
        )  # fmt: skip

    alternatives: dict[str, Callable[[], object]] = {
        "ours": ours,
        "torch": lambda: autograd_step(plain, samples, empty, near, batch, config),
        "march": lambda: torch_reference.march(batch.rays, replay.correspondences, grid, how),
    }  # fmt: skip
    ours(replace(config, faint_gradient_share=0.0))
    strays = _largest_difference(field.parameters(), alternatives["torch"]())
    ms = {name: 1000.0 * time for name, time in time_interleaved(alternatives).items()}
    return [
        Measurement(
            name="one step vs plain torch on the same samples, times",
            value=ms["torch"] / ms["ours"], required="4", stretch_goal="8",
            context=f"{config.rays:,} rays of one frame, {len(samples.points) / config.rays:.1f} "
            f"samples/ray: {ms['ours']:.1f} ms with marching, torch "
            f"{ms['torch']:.0f} ms without (its own marching: +{ms['march']:.0f} ms, not counted); "
            f"largest difference of a gradient {strays:.0e} of its largest",
        ),
    ]  # fmt: skip


def _largest_difference(parameters: list[torch.nn.Parameter], plain: object) -> float:
    """Largest difference between gradients, each relative to its parameter's largest."""
    assert isinstance(plain, tuple)
    both = zip(parameters, plain, strict=True)
    return max(float((p.grad - g).abs().max() / g.abs().max()) for p, g in both)


def _seeded() -> torch.Generator:
    return torch.Generator().manual_seed(0)

"""Where a step looks along its rays: the seam between our scheme and the paper's.

One training step: the only place where the operations meet, without autograd.
"""

import math
from typing import NamedTuple, Protocol, final, runtime_checkable

import torch
from jaxtyping import Float32, Int32
from torch import Tensor

from avatar.config import TrainConfig
from avatar.field import field_priors
from avatar.field.occupancy_grid import OccupancyGrid
from avatar.field.radiance_field import RadianceField
from avatar.kernels.backend_protocol import (
    Backend,
    CorrespondenceTables,
    DensityGrid,
    MarchSettings,
    RayBatch,
    RaySamples,
)
from avatar.pose.pose_optimizer import MIN_POSE_GRADIENT_CELL_M, PoseOptimizer
from avatar.training.replay_buffer import TrainingBatch


@runtime_checkable
class RaySampler(Protocol):
    """Decides which canonical points a step asks the field about.

    Ours is `OccupancySampler`; the paper's are in `baselines.instant_avatar`.
    """

    def sample_rays(self, rays: RayBatch, cells: CorrespondenceTables) -> RaySamples:
        """Canonical samples along rays of the body frames that `cells` warps."""
        ...

    def sample_empty(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Canonical points that should hold nothing, at most `count`."""
        ...

    def sample_interior(
        self, count: int, generator: torch.Generator
    ) -> Float32[Tensor, "points 3"]:
        """Canonical points where the body is solid, at most `count`."""
        ...

    def sample_inner_leg(
        self, count: int, generator: torch.Generator
    ) -> Float32[Tensor, "points 3"]:
        """Canonical points off the skin between the legs, at most `count`."""
        ...

    def add_frame(
        self, slot: int, cells: CorrespondenceTables, bones: Float32[Tensor, "24 12"]
    ) -> None:
        """Learns that a slot holds another frame from now on.

        Args:
            slot: Which.
            cells: The warp of all slots, this one's included.
            bones: From canonical to body frame, of the frame's pose.
        """
        ...

    def update(self, steps: int, cells: CorrespondenceTables, generator: torch.Generator) -> None:
        """Looks, after each step, whether what it knows of empty space must be renewed.

        Args:
            steps: How many were done before this one.
            cells: The warp of all slots.
            generator: Of everything random, on the field's device.
        """
        ...


@final
class OccupancySampler:
    """Ours: warp cells, then canonical occupancy, then an end where rays have become opaque."""

    def __init__(self, backend: Backend, occupancy: OccupancyGrid, config: TrainConfig) -> None:
        """Samples what `occupancy` holds; whoever owns that keeps it up to date."""
        self._backend = backend
        self._occupancy = occupancy
        self._march_settings = MarchSettings(
            config.sample_step_m, config.opaque_margin_m, config.max_samples
        )

    def sample_rays(self, rays: RayBatch, cells: CorrespondenceTables) -> RaySamples:
        """Samples of occupied cells, as far as the ray's cached optical depth lets it through."""
        return self._backend.march(rays, cells, self._occupancy.density_grid, self._march_settings)

    def sample_empty(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Random points of cells near the skin that hold nothing."""
        return self._occupancy.sample_empty(count, generator)

    def sample_interior(
        self, count: int, generator: torch.Generator
    ) -> Float32[Tensor, "points 3"]:
        """Random points deep under the skin."""
        return self._occupancy.sample_interior(count, generator)

    def sample_inner_leg(
        self, count: int, generator: torch.Generator
    ) -> Float32[Tensor, "points 3"]:
        """Random points off the skin between the legs."""
        return self._occupancy.sample_inner_leg(count, generator)

    def add_frame(
        self, slot: int, cells: CorrespondenceTables, bones: Float32[Tensor, "24 12"]
    ) -> None:
        """Nothing to learn: canonical occupancy is every pose's."""

    def update(self, steps: int, cells: CorrespondenceTables, generator: torch.Generator) -> None:
        """Nothing to renew."""


class StepResult(NamedTuple):
    """What a step tells.

    Attributes:
        loss: Of each ray.
        samples: How many samples its rays had.
    """

    loss: Float32[Tensor, "rays"]
    sample_count: int


@torch.no_grad()
def compute_gradients(
    field: RadianceField,
    sampler: RaySampler,
    correspondences: CorrespondenceTables,
    batch: TrainingBatch,
    config: TrainConfig,
    *,
    hard_surface_share: float,
    surface_share: float = 0.0,
    density_cache: DensityGrid | None = None,
    poses: PoseOptimizer | None = None,
    generator: torch.Generator,
) -> StepResult:
    """Renders a batch and leaves the gradient of its mean loss in the field's parameters.

    Args:
        field: What is learnt.
        sampler: Where samples lie.
        cells: Warp cells of the frames that the batch's slots name.
        batch: Rays and what the video shows along them.
        config: The recipe.
        hard_surface_share: Share of the hard-surface loss's weight, in [0, 1]: it grows in, for a surface
            must be found before it can be hard.
        surface_share: How far, in [0, 1], surfaces have come from being found (smooth, and fog where
            poses do not agree yet) to being firm.
        remember: Whose cached densities the samples' raise, if any.
        poses: Whose wrenches take up what pulls the samples, if poses are refined.
        generator: Of backgrounds and of the points that are asked, on the field's device.
    """
    samples = sampler.sample_rays(batch.rays, correspondences)
    asked = _regularization_points(sampler, samples.points, config, generator)
    seen = field.forward(torch.cat([samples.points, *asked]))
    raw, *raw_asked = seen.raw.split([len(points) for points in (samples.points, *asked)])
    count = len(raw)
    background = torch.rand(len(batch.target), 3, generator=generator, device=generator.device)
    _, loss, grad = field.backend.composite_loss(
        raw, samples, config.sample_step_m, batch.target, background,
        config.alpha_weight, config.hard_surface_weight * hard_surface_share,
    )  # fmt: skip
    grads = [grad, *_regularization_gradients(raw_asked, asked, config, surface_share)]
    grad_features = field.backward(seen, torch.cat(grads))
    if poses is not None and count:
        _accumulate_pose_gradients(
            poses, field, samples, grad_features[:count], batch.rays.slots, correspondences, loss
        )
    if density_cache is not None:
        log_density = raw[:, 3].contiguous()
        field.backend.scatter_max_density(seen.points[:count], log_density, density_cache)
    return StepResult(loss, count)


def _regularization_points(
    sampler: RaySampler,
    points: Float32[Tensor, "samples 3"],
    config: TrainConfig,
    generator: torch.Generator,
) -> list[Float32[Tensor, "_ 3"]]:
    """Points that are asked besides the rays': empty, pairs, solid, close pairs, gaps."""
    none = points[:0]
    return [
        sampler.sample_empty(config.empty_space_points, generator).to(points)
        if config.empty_space_weight
        else none,
        field_priors.sample_tv_pairs(points, config, generator),
        sampler.sample_interior(config.interior_points, generator).to(points)
        if config.interior_weight
        else none,
        field_priors.sample_smoothness_pairs(points, config, generator),
        sampler.sample_inner_leg(config.inner_leg_points, generator).to(points)
        if config.inner_leg_weight
        else none,
    ]


def _regularization_gradients(
    raw: list[Float32[Tensor, "_ 4"]],
    points: list[Float32[Tensor, "_ 3"]],
    config: TrainConfig,
    surface_share: float,
) -> list[Float32[Tensor, "_ 4"]]:
    """The gradients of what `_asked` asks, in its order."""
    empty, pairs, solid, close, gaps = raw
    grad_pairs = field_priors.density_tv_gradient(pairs, config.density_tv_weight_at(surface_share))
    if config.double_well_weight:
        grad_pairs += field_priors.double_well_gradient(
            pairs, config.double_well_weight * surface_share
        )
    grad_close = field_priors.density_slope_gradient(
        close,
        points[3],
        config.max_log_density_slope_per_m,
        config.density_slope_weight * surface_share,
    )
    grad_close += field_priors.color_tv_gradient(close, config.color_tv_weight * surface_share)
    return [
        field_priors.empty_space_gradient(empty, config.empty_space_weight),
        grad_pairs,
        field_priors.interior_gradient(solid, config.interior_weight),
        grad_close,
        field_priors.log_density_l1_gradient(gaps, config.inner_leg_weight),
    ]


def _accumulate_pose_gradients(
    poses: PoseOptimizer,
    field: RadianceField,
    samples: RaySamples,
    grad_features: Float32[Tensor, "samples width"],
    slots: Int32[Tensor, "rays"],
    cells: CorrespondenceTables,
    loss: Float32[Tensor, "rays"],
) -> None:
    """Lets the samples pull at the poses that they were warped with."""
    backend, levels = field.backend, field.levels.coarser_than(MIN_POSE_GRADIENT_CELL_M)
    each = grad_features[:, : levels.feature_width] * len(
        loss
    )  # of each ray's own loss, not of the mean
    grad_points = backend.encode_points_backward(samples.points, each, field.table, levels)
    wrenches = backend.bone_wrenches(
        samples, grad_points, slots, cells, poses.skinning, poses.bones
    )
    poses.accumulate(slots.long(), wrenches, loss)


def cosine_decay(progress: float) -> float:
    """The learning rate's factor: 1 at progress 0, 0.05 at 1."""
    return max(0.05, 0.5 * (1.0 + math.cos(math.pi * min(max(progress, 0.0), 1.0))))

"""One training step: sample, query the field, composite, and propagate gradients by hand."""

from typing import NamedTuple, Protocol, final, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32, Int32, Int64
from torch import Tensor

from avatar import radiance_field
from avatar.avatar_model import Avatar
from avatar.config import TrainConfig
from avatar.kernels import operations
from avatar.kernels.numba_drawing import draw_strong_gradients
from avatar.kernels.operands import (
    CorrespondenceTables,
    MarchSettings,
    PremultipliedPixels,
    RayBatch,
    RaySamples,
)
from avatar.occupancy_grid import OccupancyGrid
from avatar.radiance_field import RadianceField
from avatar.training.pose_optimizer import PoseOptimizer
from avatar.training.replay_buffer import TrainingBatch
from avatar.training.unseen_skin import SourcePairs, UnseenSkin


@runtime_checkable
class RaySampler(Protocol):
    """Chooses the canonical points at which a step queries the field.

    `OccupancySampler` is the implementation; `baselines.instant_avatar` has the paper's.
    """

    def sample_rays(self, rays: RayBatch, correspondences: CorrespondenceTables) -> RaySamples:
        """Canonical samples along rays in the body frames that `correspondences` covers."""
        ...

    def sample_empty(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """At most `count` canonical points at which density is penalised."""
        ...

    def sample_source_pairs(self, count: int, generator: torch.Generator) -> SourcePairs:
        """At most `count` points of unseen skin, and what they are drawn to."""
        ...


@final
class OccupancySampler:
    """Samples occupied canonical cells, up to the cached surface that makes a ray opaque.

    `sample_step_m`, the distance between samples along a ray, may be changed at any time.
    """

    def __init__(
        self, occupancy: OccupancyGrid, config: TrainConfig, unseen: UnseenSkin | None = None
    ) -> None:
        """Reads `occupancy` and `unseen` at every call; their owner keeps them up to date."""
        self._unseen = unseen if config.unseen_weight else None
        self._occupancy = occupancy
        self._config = config
        self.sample_step_m = config.sample_step_m

    def sample_rays(self, rays: RayBatch, correspondences: CorrespondenceTables) -> RaySamples:
        """Canonical samples in occupied cells, until the cached optical depth ends the ray."""
        return operations.march(
            rays,
            correspondences,
            self._occupancy.density_grid,
            MarchSettings(
                self.sample_step_m, self._config.opaque_margin_m, self._config.max_samples
            ),
        )

    def sample_empty(self, count: int, generator: torch.Generator) -> Float32[Tensor, "points 3"]:
        """Random points in unoccupied cells near the skin, at most `count`."""
        return self._occupancy.sample_empty(count, generator)

    def sample_source_pairs(self, count: int, generator: torch.Generator) -> SourcePairs:
        """Points of unseen skin and their sources, at most `count`; none without `unseen`."""
        if self._unseen is None:
            return SourcePairs.none()
        return self._unseen.sample(count, generator)


class StepResult(NamedTuple):
    """Loss, shaded rendering and world normal of each ray, and the number of all their samples."""

    loss: Float32[Tensor, "rays"]
    rendered: PremultipliedPixels
    normals: Float32[Tensor, "rays 3"]
    sample_count: int


@torch.no_grad()
def compute_gradients(
    learner: Avatar,
    sampler: RaySampler,
    correspondences: CorrespondenceTables,
    batch: TrainingBatch,
    config: TrainConfig,
    *,
    hard_surface_share: float,
    surface_share: float = 0.0,
    caches_density: bool = False,
    poses: PoseOptimizer | None = None,
    generator: torch.Generator,
) -> StepResult:
    """Renders a batch and adds the gradient of its mean loss to the field's parameters.

    Args:
        hard_surface_share: Share of the hard-surface loss's weight, in [0, 1]; it grows in, because
            a surface has to be found before it can be made hard.
        surface_share: Progress from smooth densities to firm surfaces, in [0, 1].
        caches_density: Whether the samples raise the occupancy's cached densities.
        poses: Accumulates the samples' wrenches, if poses are refined.
    """
    field = learner.field
    samples = sampler.sample_rays(batch.rays, correspondences)
    asked = _regularization_points(sampler, learner.occupancy, samples.points, config, generator)
    pairs = sampler.sample_source_pairs(config.unseen_points, generator)
    asked.append(pairs.points)
    seen = field.forward(torch.cat([samples.points, *asked]))
    raw, *raw_asked = seen.raw.split([len(points) for points in (samples.points, *asked)])
    count = len(raw)
    normals = learner.shading.body_normals(
        batch.rays, samples, raw, correspondences, config.sample_step_m
    )
    normals = (batch.world_from_body @ normals[..., None])[..., 0]
    lit = learner.shading.factors(normals)
    rendered, loss, grad = operations.composite_loss(
        raw, samples, config.sample_step_m, batch.target / lit,
        config.alpha_weight, config.hard_surface_weight * hard_surface_share,
    )  # fmt: skip
    grads = [grad, *_regularization_gradients(raw_asked, asked, config, surface_share)]
    weight = config.unseen_weight / config.unseen_points
    grads += [radiance_field.source_gradient(raw_asked[-1], pairs.weights, weight)]
    drawn, drawn_grads = draw_by_strength(torch.cat(grads), config.faint_gradient_share, generator)
    grad_features = field.backward(seen, drawn_grads, drawn)
    if poses is not None and count:
        drawn = drawn[drawn < count]
        _accumulate_pose_gradients(
            poses, field, samples, drawn, grad_features, batch.rays.slots, correspondences, loss
        )
    if caches_density:
        log_density = raw[:, 3].contiguous()
        grid = learner.occupancy.density_grid
        operations.scatter_max_density(seen.points[:count], log_density, grid)
    return StepResult(loss, rendered * lit, normals, count)


def _regularization_points(
    sampler: RaySampler,
    occupancy: OccupancyGrid,
    points: Float32[Tensor, "samples 3"],
    config: TrainConfig,
    generator: torch.Generator,
) -> list[Float32[Tensor, "_ 3"]]:
    """Points of the regularizers: empty, TV pairs, interior, smoothness pairs, off skin, head."""
    none = points[:0]
    return [
        sampler.sample_empty(config.empty_space_points, generator)
        if config.empty_space_weight
        else none,
        radiance_field.sample_tv_pairs(points, config, generator),
        occupancy.sample_interior(config.interior_points, generator)
        if config.interior_weight
        else none,
        radiance_field.sample_smoothness_pairs(points, config, generator),
        occupancy.sample_off_skin(config.off_skin_points, generator)
        if config.off_skin_weight
        else none,
        occupancy.sample_interior(config.head_interior_points, generator, of_head=True)
        if config.head_interior_weight
        else none,
    ]


def _regularization_gradients(
    raw: list[Float32[Tensor, "_ 4"]],
    points: list[Float32[Tensor, "_ 3"]],
    config: TrainConfig,
    surface_share: float,
) -> list[Float32[Tensor, "_ 4"]]:
    """Gradients of the raw outputs at the points of `_regularization_points`, in their order."""
    empty, pairs, solid, close, away, head, *_ = raw
    grad_pairs = radiance_field.density_tv_gradient(pairs, config.density_tv_weight)
    if config.double_well_weight:
        grad_pairs += radiance_field.double_well_gradient(
            pairs, config.double_well_weight * surface_share
        )
    grad_close = torch.zeros_like(close)
    if len(close):
        grad_close += radiance_field.density_slope_gradient(
            close,
            points[3],
            config.max_log_density_slope_per_m,
            config.density_slope_weight * surface_share,
        )
        grad_close += radiance_field.color_tv_gradient(
            close, config.color_tv_weight * surface_share
        )
    return [
        radiance_field.empty_space_gradient(empty, config.empty_space_weight),
        grad_pairs,
        radiance_field.interior_gradient(solid, config.interior_weight) if len(solid) else solid,
        grad_close,
        radiance_field.log_density_l1_gradient(away, config.off_skin_weight) if len(away) else away,
        radiance_field.interior_gradient(
            head, config.head_interior_weight * (1.0 - surface_share) ** 2
        )
        if len(head)
        else head,
    ]


def draw_by_strength(
    grads: Float32[Tensor, "points 4"], faint_share: float, generator: torch.Generator
) -> tuple[Int64[Tensor, "drawn"], Float32[Tensor, "drawn 4"]]:
    """Draws the points whose gradients are propagated, faint ones by chance ("Russian roulette").

    Half of the samples have a negligible gradient. Leaving these out biases the sum, and Adam
    enlarges small gradients; a few of them, divided by their chance, keep the expected sum. A
    gradient is faint below `faint_share` of the mean strength. Returns points and divided
    gradients.
    """
    if not faint_share:
        return torch.arange(len(grads)), grads
    chances = torch.rand(len(grads), generator=generator)
    points, drawn = np.empty(len(grads), dtype=np.int64), np.empty(grads.shape, dtype=np.float32)
    count = draw_strong_gradients(grads.numpy(), faint_share, chances.numpy(), points, drawn)
    return torch.from_numpy(points[:count]), torch.from_numpy(drawn[:count])


def _accumulate_pose_gradients(
    poses: PoseOptimizer,
    field: RadianceField,
    samples: RaySamples,
    drawn: Int64[Tensor, "drawn"],
    grad_features: Float32[Tensor, "points width"],
    slots: Int32[Tensor, "rays"],
    cells: CorrespondenceTables,
    loss: Float32[Tensor, "rays"],
) -> None:
    """Adds the wrenches that the samples exert on the bones of their frames' poses."""
    levels = field.levels.coarser_than(poses.min_gradient_cell_m)
    # undo the mean over rays: a pose is judged by the loss of each of its rays
    grad_points = operations.encode_points_backward(
        samples.points,
        drawn,
        grad_features[: len(drawn)],
        field.table,
        levels,
        factor=float(len(loss)),
    )
    wrenches = operations.bone_wrenches(
        samples, grad_points, slots, cells, poses.skinning, poses.bones
    )
    poses.accumulate(slots.long(), wrenches, loss)

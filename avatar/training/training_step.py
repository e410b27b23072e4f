"""One training step: sample, query the field, composite, and propagate gradients by hand."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from avatar import radiance_field
from avatar.avatar_model import Avatar
from avatar.config import TrainConfig
from avatar.kernels import operations
from avatar.kernels.operands import (
    CLOSE_PAIRS,
    EMPTY_SPACE,
    HEAD_INTERIOR,
    INTERIOR,
    OFF_SKIN,
    SOURCE_PAIRS,
    TV_PAIRS,
    CorrespondenceTables,
    LossSettings,
    MarchSettings,
    PosedBones,
    PremultipliedPixels,
    PriorPoints,
)
from avatar.occupancy_grid import OccupancyGrid
from avatar.training.pose_optimizer import PoseOptimizer
from avatar.training.replay_buffer import TrainingBatch
from avatar.training.unseen_skin import SourcePairs, UnseenSkin

TV_SEED, SMOOTHNESS_SEED = 0x5BD1E995, 0x9E3779B9
"""Bits by which the seeds of a step's pairs differ from that of its draw of gradients."""


class StepResult(NamedTuple):
    """Loss, shaded rendering and world normal of each ray, and the number of all their samples."""

    loss: Float32[Tensor, "rays"]
    rendered: PremultipliedPixels
    normals: Float32[Tensor, "rays 3"]
    sample_count: int


@torch.no_grad()
def compute_gradients(
    learner: Avatar,
    correspondences: CorrespondenceTables,
    batch: TrainingBatch,
    config: TrainConfig,
    *,
    hard_surface_share: float,
    surface_share: float = 0.0,
    caches_density: bool = False,
    unseen: UnseenSkin | None = None,
    poses: PoseOptimizer | None = None,
    generator: torch.Generator,
) -> StepResult:
    """Renders a batch and adds the gradient of its mean loss to the field's parameters.

    Half of the samples have a negligible gradient. Leaving these out biases the sum, and Adam
    enlarges small gradients; a few of them, divided by their chance, keep the expected sum
    ("Russian roulette"). They are those below a share of the mean strength in the step before.

    Args:
        hard_surface_share: Share of the hard-surface loss's weight, in [0, 1]; it grows in, because
            a surface has to be found before it can be made hard.
        surface_share: Progress from smooth densities to firm surfaces, in [0, 1].
        caches_density: Whether the samples raise the occupancy's cached densities.
        unseen: Skin that is drawn to its source, if any.
        poses: Accumulates the samples' wrenches, if poses are refined.
    """
    field = learner.field
    seed = int(torch.randint(1 << 32, (), generator=generator))
    how = MarchSettings(config.sample_step_m, config.opaque_margin_m, config.max_samples)
    grid = learner.occupancy.density_grid
    samples = operations.march(batch.rays, correspondences, grid, how)
    priors = _prior_points(
        learner.occupancy, unseen, samples.points, config, surface_share, seed, generator
    )
    count, bones = len(samples.points), None
    if poses is not None and count:
        levels = field.levels.count_from(poses.min_gradient_cell_m)
        bones = PosedBones(poses.skinning, poses.bones, levels)
    learnt = operations.learn(
        batch.rays, batch.target, batch.world_from_body, samples, correspondences, priors,
        learner.shading.lit_skin(), bones, seed, field.table, field.levels, field.network,
        LossSettings(
            config.sample_step_m, config.alpha_weight,
            config.hard_surface_weight * hard_surface_share,
            config.faint_gradient_share * field.gradient_strength,
        ),
        is_frozen=field.is_frozen,
    )  # fmt: skip
    field.add_gradients(learnt)
    field.gradient_strength = learnt.strength
    if poses is not None and bones is not None:
        poses.accumulate(batch.rays.slots, learnt.wrenches, learnt.loss)
    if caches_density:
        operations.scatter_max_density(samples.points, learnt.log_density.contiguous(), grid)
    return StepResult(learnt.loss, learnt.rendered, learnt.normals, count)


def _prior_points(
    occupancy: OccupancyGrid,
    unseen: UnseenSkin | None,
    points: Float32[Tensor, "samples 3"],
    config: TrainConfig,
    surface_share: float,
    seed: int,
    generator: torch.Generator,
) -> PriorPoints:
    """Draws the points at which priors hold, and weighs the priors' terms."""
    pairs = SourcePairs.none()
    if unseen is not None and config.unseen_weight:
        pairs = unseen.sample(config.unseen_points, generator)

    def in_cells(kind: int, weight: float, count: int) -> Float32[Tensor, "points 3"]:
        return occupancy.sample(kind, count, generator) if weight else points[:0]

    lists = [
        in_cells(EMPTY_SPACE, config.empty_space_weight, config.empty_space_points),
        radiance_field.sample_tv_pairs(points, config, seed ^ TV_SEED),
        in_cells(INTERIOR, config.interior_weight, config.interior_points),
        radiance_field.sample_smoothness_pairs(points, config, seed ^ SMOOTHNESS_SEED),
        in_cells(OFF_SKIN, config.off_skin_weight, config.off_skin_points),
        in_cells(HEAD_INTERIOR, config.head_interior_weight, config.head_interior_points),
        pairs.points,
    ]
    weights = np.zeros((len(lists), 2), dtype=np.float32)
    weights[EMPTY_SPACE, 0] = config.empty_space_weight
    weights[TV_PAIRS] = config.density_tv_weight, config.double_well_weight * surface_share
    weights[INTERIOR, 0] = config.interior_weight
    weights[CLOSE_PAIRS] = (
        config.density_slope_weight * surface_share,
        config.color_tv_weight * surface_share,
    )
    weights[OFF_SKIN, 0] = config.off_skin_weight
    weights[HEAD_INTERIOR, 0] = config.head_interior_weight * (1.0 - surface_share) ** 2
    weights[SOURCE_PAIRS, 0] = config.unseen_weight / config.unseen_points
    return PriorPoints(lists, pairs.weights, weights, config.max_log_density_slope_per_m)

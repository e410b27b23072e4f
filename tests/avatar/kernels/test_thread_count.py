"""Operations are bit-equal for any number of threads."""

import numba
import numpy as np
import torch

from avatar.kernels import operations
from avatar.kernels.operands import (
    AdamArrays,
    AdamSettings,
    FeatureGradients,
    LossSettings,
    MarchSettings,
    PosedBones,
    PriorPoints,
)


def results_of(learnt) -> dict[str, list[torch.Tensor]]:
    """What every operation of a step makes of one batch of rays."""
    trainer, generator = learnt.trainer, torch.Generator().manual_seed(0)
    field, poses = trainer.avatar.field, trainer.poses
    batch, cells = trainer.replay.sample_rays(700, generator), trainer.replay.correspondences
    grid = trainer.avatar.occupancy.density_grid
    grid = grid._replace(density=grid.density.clone())
    samples = operations.march(batch.rays, cells, grid, MarchSettings(0.01, 0.06, 128))
    points, count = samples.points, len(samples.points)
    raw = torch.randn(count, 4, generator=generator)
    slope = torch.randn(count, field.levels.feature_width, generator=generator)
    grad_table = torch.zeros_like(field.table)
    rows = torch.arange(0, count, 2)
    parts = FeatureGradients(rows.numpy(), slope[rows].numpy(), np.array([[0, len(rows)]]))
    operations.add_table_gradient(points, parts, field.levels, grad_table)
    features, outputs = operations.field_forward(points, field.table, field.levels, field.network)
    operations.scatter_max_density(points, raw[:, 3].contiguous(), grid)
    learnt = operations.learn(
        batch.rays, batch.target, batch.world_from_body, samples, cells,
        PriorPoints([points[:300]] + [points[:0]] * 6, points[0, :0], np.ones((7, 2), "f4"), 1.0),
        trainer.learner.shading.lit_skin(), PosedBones(poses.skinning, poses.bones, 4),
        1, field.table, field.levels, field.network,
        LossSettings(0.01, 0.1, 0.1, 1e-5),
    )  # fmt: skip
    moved = cells._replace(roots=cells.roots.clone())
    operations.update_roots(moved, [0], poses.skinning, poses.bones)
    volume = trainer.learner.shading.normals
    normals = operations.mean_normals(raw, samples, 0.01, batch.rays.slots, cells, volume)
    stepped = [grad_table.clone(), *(torch.ones_like(grad_table) for _ in range(3))]
    arrays = AdamArrays(*(part.numpy().reshape(-1) for part in stepped))
    operations.adam_step([(AdamSettings(0.01, (0.9, 0.99), 1e-15, 1), arrays)])
    return {
        "mean_normals": [normals],
        "adam_step": stepped[1:],
        "field_forward": [features, outputs],
        "add_table_gradient": [grad_table],
        "march": list(samples),
        "composite": [operations.composite(raw, samples, 0.01)],
        "learn": [
            learnt.log_density,
            learnt.rendered,
            learnt.loss,
            learnt.wrenches,
            *(torch.from_numpy(np.ascontiguousarray(grad)) for grad in learnt.network),
        ],
        "scatter_max_density": [grid.density],
        "update_roots": [moved.roots[0, : int((cells.packed_cells[0] >> 3).max())]],
    }


def test_every_operation_is_bit_equal_for_any_number_of_threads(learnt):
    before, results = numba.get_num_threads(), []
    try:
        for threads in range(1, numba.config.NUMBA_NUM_THREADS + 1):
            numba.set_num_threads(threads)
            results.append(results_of(learnt))
    finally:
        numba.set_num_threads(before)
    for name, alone in results[0].items():
        assert all(float(part.float().abs().max()) > 0 for part in alone), name
        for others in results[1:]:
            for one, other in zip(alone, others[name], strict=True):
                assert torch.equal(one, other), name

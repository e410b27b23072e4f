"""Compiled kernels against plain torch, closed forms, and themselves on any number of threads."""

import math

import numba
import numpy as np
import pytest
import torch

from avatar.correspondence_grid import CorrespondenceGrid
from avatar.kernels import numba_rendering, operations
from avatar.kernels.operands import (
    FEATURES_PER_LEVEL,
    MAX_LOG_DENSITY,
    AdamArrays,
    AdamSettings,
    CorrespondenceTables,
    FeatureGradients,
    LossSettings,
    MarchSettings,
    NormalVolume,
    PosedBones,
    PriorPoints,
    RayBatch,
    RaySamples,
)
from avatar.occupancy_grid import OccupancyGrid
from avatar.render import correspondence_tables
from baselines import torch_reference


def points_in(levels, count, generator, *, beyond=0.0):
    extent = torch.from_numpy((levels.vertex_counts[0] - 1) / levels.cells_per_m[0])
    unit = torch.rand(count, 3, generator=generator) * (1 + 2 * beyond) - beyond
    return torch.from_numpy(levels.low) + unit * extent.float()


def packed(counts):
    counts = torch.tensor(counts, dtype=torch.int32)
    total = int(counts.sum())
    first = torch.cumsum(counts, 0) - counts
    return RaySamples(torch.zeros(total, 3), first, counts, torch.zeros(total, dtype=torch.int32))


def encoded(points, table, levels):
    layers = [torch.zeros(shape) for shape in ((levels.feature_width, 64), 64, (64, 4), 4)]
    return operations.field_forward(points, table, levels, tuple(layers))[0]


def test_features_at_a_vertex_of_a_dense_level_are_its_entry(levels, generator):
    assert levels.is_dense.tolist() == [1, 1, 0, 0]
    table = torch.randn(levels.entries, FEATURES_PER_LEVEL, generator=generator)
    i, j, k = 3, 2, 1
    point = torch.from_numpy(levels.low) + torch.tensor([i, j, k]) / float(levels.cells_per_m[0])
    features = encoded(point[None].float(), table, levels)
    nx, ny, _ = levels.vertex_counts[0].tolist()
    torch.testing.assert_close(
        features[0, :FEATURES_PER_LEVEL], table[i + nx * (j + ny * k)], atol=1e-5, rtol=0
    )


@pytest.mark.parametrize("count", [0, 1, 700])
def test_compiled_encoding_agrees_with_its_meaning(levels, generator, count):
    table = torch.randn(levels.entries, FEATURES_PER_LEVEL, generator=generator)
    points = points_in(levels, count, generator, beyond=0.1)
    torch.testing.assert_close(
        encoded(points, table, levels), torch_reference.encode(points, table, levels),
        atol=1e-4, rtol=1e-5,
    )  # fmt: skip


def test_a_uniform_fog_absorbs_as_beer_and_lambert_say():
    raw = torch.tensor([[50.0, -50.0, 0.0, math.log(3.0)]]).repeat(40, 1)
    rendered = operations.composite(raw, packed([40]), 0.01)
    alpha = 1.0 - math.exp(-3.0 * 0.4)
    expected = torch.tensor([[alpha, 0.0, 0.5 * alpha, alpha]])
    torch.testing.assert_close(rendered, expected, atol=1e-5, rtol=0)


def loss_case(generator, counts=(5, 0, 1, 30, 17)):
    samples = packed(list(counts))
    rays = len(counts)
    raw = torch.randn(sum(counts), 4, generator=generator)
    raw[:, 3] += 3.0
    target = torch.rand(rays, 4, generator=generator)
    target[:, :3] *= target[:, 3:]
    return raw, samples, 0.01, target, 0.1, 0.1


def composite_loss(raw, samples, step_m, target, alpha_weight, hard_weight):
    """Rendering, loss and gradient of the mean loss, ray by ray."""
    rays, grad = len(samples.counts), torch.empty_like(raw)
    rendered, loss = torch.empty(rays, 4), torch.empty(rays)
    for ray in range(rays):
        numba_rendering.composite_ray_loss(
            ray, raw.numpy(), samples.offsets.numpy(), samples.counts.numpy(), np.float32(step_m),
            target.numpy(), np.float32(alpha_weight), np.float32(hard_weight), rendered.numpy(),
            loss.numpy(), grad.numpy(),
        )  # fmt: skip
    return rendered, loss, grad


def test_compiled_normals_agree_with_their_meaning_and_lie_on_rays_that_see_something(generator):
    raw, samples, step_m, *_ = loss_case(generator, counts=(5, 0, 1, 30, 17))
    count = len(raw)
    samples = samples._replace(
        points=torch.rand(count, 3, generator=generator),
        root_rows=torch.randint(9, (count,), generator=generator).int(),
    )
    normals = torch.nn.functional.normalize(torch.randn(6, 5, 4, 3, generator=generator), dim=-1)
    volume = NormalVolume(normals, torch.full((3,), -0.05), torch.tensor([6.0, 5.0, 4.0]))
    roots = torch.randn(2, 9, 12, generator=generator)
    cells = CorrespondenceTables(
        torch.zeros(2, 1), roots, torch.zeros(2, 3), torch.zeros(2, 3), 0.03
    )
    slots = torch.tensor([0, 0, 1, 1, 1], dtype=torch.int32)
    ours, theirs = (
        module.mean_normals(raw, samples, step_m, slots, cells, volume)
        for module in (operations, torch_reference)
    )
    torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=1e-4)
    assert not ours[1].any()
    assert (ours.norm(dim=1) <= operations.composite(raw, samples, step_m)[:, 3] + 1e-5).all()
    assert ours[0].any()


def test_normals_turn_without_steps_from_cell_to_cell(generator):
    """Light that changes at the borders of the volume's cells shows as patches on a hand."""
    count = 2000
    along = torch.linspace(0.0, 1.0, count)[:, None]
    samples = packed([1] * count)._replace(
        points=along * torch.tensor([1.0, 0.9, 0.8]),
        root_rows=torch.zeros(count, dtype=torch.int32),
    )
    normals = torch.nn.functional.normalize(torch.rand(6, 5, 4, 3, generator=generator), dim=-1)
    volume = NormalVolume(normals, torch.zeros(3), torch.tensor([6.0, 5.0, 4.0]))
    warp = torch.cat([torch.zeros(3), torch.eye(3).flatten()])
    cells = CorrespondenceTables(
        torch.zeros(1, 1), warp[None, None], torch.zeros(1, 3), torch.zeros(1, 3), 0.03
    )
    opaque, slots = torch.full((count, 4), 9.0), torch.zeros(count, dtype=torch.int32)
    found = operations.mean_normals(opaque, samples, 0.01, slots, cells, volume)
    assert (found[0] - normals[0, 0, 0]).norm() < 1e-3
    assert found.diff(dim=0).norm(dim=1).max() < 0.02  # from cell to cell it is up to 1.4


def test_the_loss_and_its_gradient_are_exact_however_opaque_a_ray(generator):
    """Behind an opaque sample a gradient is nothing, not rounding times a large optical depth."""
    raw, samples, *rest = loss_case(generator, counts=(60, 90, 40, 1, 80))
    raw[:, 3] = 8.9 - 6.0 * torch.rand(len(raw), generator=generator)
    step_m, target, *weights = rest
    leaf = raw.double().requires_grad_()
    rendered = torch_reference.composite(leaf, samples.offsets, samples.counts, step_m)
    loss = torch_reference.loss_per_ray(rendered, target.double(), *weights)
    (expected,) = torch.autograd.grad(loss.mean(), leaf)
    colors, losses, grad = composite_loss(raw, samples, *rest)
    torch.testing.assert_close(colors.double(), rendered.detach(), atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(losses.double(), loss.detach(), atol=1e-6, rtol=1e-4)
    assert float((grad - expected).abs().max()) <= 2e-6 * float(expected.abs().max())


def test_the_density_of_a_saturated_sample_has_no_gradient(generator):
    raw, *rest = loss_case(generator)
    raw[3, 3] = MAX_LOG_DENSITY + 1.0
    assert composite_loss(raw, *rest)[2][3, 3] == 0.0


@pytest.fixture(scope="module")
def scene(rig):
    """A bent body with a dense core, seen from all sides."""
    rotations = np.zeros((23, 3))
    rotations[15, 2], rotations[16, 2], rotations[17, 1] = -1.0, 0.8, -0.8
    generator = torch.Generator().manual_seed(1)
    grid = OccupancyGrid(rig).density_grid
    distance = torch.from_numpy(rig.skin_distance)
    grid.density.copy_(torch.where(distance < 0.02, 400.0, 0.5) * (distance < 0.05))
    grid.occupied.copy_((distance < 0.05).to(torch.uint8))
    cells = correspondence_tables(CorrespondenceGrid.solve(rig, rotations))
    origins = torch.randn(300, 3, generator=generator)
    origins = torch.nn.functional.normalize(origins, dim=1) * 3.0
    aim = torch.rand(300, 3, generator=generator) * torch.tensor([0.8, 1.6, 0.3])
    aim -= torch.tensor([0.4, 1.0, 0.15])
    rays = RayBatch(
        origins, torch.nn.functional.normalize(aim - origins, dim=1),
        torch.zeros(300, dtype=torch.int32), torch.rand(300, generator=generator),
    )  # fmt: skip
    return rays, cells, grid


@pytest.mark.parametrize("grace_m", [0.06, math.inf], ids=["training", "exact"])
def test_compiled_marching_agrees_with_its_meaning(scene, grace_m):
    how = MarchSettings(0.01, grace_m, 96)
    ours, (theirs, _) = operations.march(*scene, how), torch_reference.march(*scene, how)
    agree = ours.counts == theirs.counts
    assert agree.float().mean() > 0.97  # a lattice point on a wall may fall on either side
    assert int(ours.counts.sum()) > 2000
    a, b = (samples.points[agree.repeat_interleave(samples.counts)] for samples in (ours, theirs))
    off = (a - b).norm(dim=1)
    assert float((off < 1e-3).float().mean()) > 0.995


def test_a_ray_that_stops_goes_on_where_it_was(scene):
    """Seven samples at a time are, one after the other, those of the whole ray."""
    rays, cells, grid = scene
    whole = operations.march(rays, cells, grid, MarchSettings(0.01, math.inf, 512))
    parts = [[] for _ in rays.slots]
    alive = torch.arange(len(rays.slots))
    while len(alive):
        some, jitter = operations.march_resumable(
            rays, cells, grid, MarchSettings(0.01, math.inf, 7)
        )
        for ray, points in zip(alive, some.points.split(some.counts.tolist()), strict=True):
            parts[ray].append(points)
        on = some.counts == 7
        alive = alive[on]
        rays = RayBatch(rays.origins[on], rays.directions[on], rays.slots[on], jitter[on])
    assert max(map(len, parts)) > 5
    # the offset of the lattice is rounded once more with every part
    torch.testing.assert_close(
        torch.cat([torch.cat(part) for part in parts]), whole.points, atol=1e-5, rtol=0
    )


def test_densities_only_rise_and_to_the_highest_sample(scene):
    grid = scene[2]._replace(density=torch.full_like(scene[2].density, 2.0))
    low, scale = grid.low, grid.cells_per_m
    here = low + (torch.tensor([[4.3, 5.2, 6.9], [4.9, 5.9, 6.1], [7.5, 7.5, 7.5]])) / scale
    outside = low - 1.0
    points = torch.cat([here, outside[None]]).float()
    log_density = torch.tensor([3.0, 2.0, -1.0, 5.0])
    operations.scatter_max_density(points, log_density, grid)
    assert float(grid.density[4, 5, 6]) == pytest.approx(math.exp(3.0), rel=1e-5)
    assert float(grid.density[7, 7, 7]) == 2.0
    assert int((grid.density != 2.0).sum()) == 1


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

"""A step: its hand-written gradient, Adam's step by our kernel, and the field's running mean."""

import dataclasses
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from avatar import radiance_field
from avatar.config import TrainConfig
from avatar.evaluation.held_out import score_frame
from avatar.kernels import numba_priors, numba_training_step, operations
from avatar.kernels.numba_priors import OPACITY_LENGTH_M
from avatar.kernels.operands import (
    EMPTY_SPACE,
    INTERIOR,
    OFF_SKIN,
    MarchSettings,
    RaySamples,
)
from avatar.radiance_field import RadianceField
from avatar.training import trainer as trainer_module
from avatar.training.frame_stream import prepare_frame
from avatar.training.pose_optimizer import PoseOptimizer
from avatar.training.trainer import (
    EMA_HORIZON_STEPS,
    EMA_INTERVAL,
    Trainer,
    UncompiledAdam,
    cosine_decay,
    step_optimizer,
    update_ema,
)
from avatar.training.training_step import SMOOTHNESS_SEED, TV_SEED, compute_gradients
from baselines import torch_reference
from tests.avatar_fixtures import pose_gradient, untaught

FIRM_SHARE = 0.25
"""Far from 0 and 1, so that no term may be left out."""
CONFIG = TrainConfig(
    rays=200, sample_step_m=0.02, finest_m=0.03, table_size=1 << 12, levels=4,
    empty_space_points=32, empty_space_weight=0.3, hard_surface_weight=0.1, density_tv_weight=0.2,
    density_tv_pairs=16, double_well_weight=0.4,
    interior_weight=0.1, interior_points=24, max_samples=256,
    density_slope_weight=0.2, color_tv_weight=0.3, smoothness_pairs=40,
    off_skin_weight=0.5, off_skin_points=20, unseen_weight=0.0, faint_gradient_share=0.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def trainer(rig, clip):
    """After 40 steps; tests leave it as it is."""
    trainer = Trainer(rig, CONFIG)
    for observation in clip.observations[:4]:
        trainer.add_frame(prepare_frame(observation, rig))
    for _ in range(40):
        trainer.step(rate=1.0, hard_surface_share=1.0)
    return trainer


def mean_loss(trainer, parameters, samples, empty, pairs, solid, close, gaps, batch):
    """The whole loss of a step, differentiable, in whatever precision the parameters have."""
    table, first, first_bias, second, second_bias = parameters
    points = torch.cat([samples.points, empty, pairs, solid, close, gaps]).to(table.dtype)
    features = torch_reference.encode(points, table, trainer.avatar.field.levels)
    hidden = torch.relu(features @ first + first_bias)
    raw = hidden @ second + second_bias
    count = len(samples.points)
    rendered = torch_reference.composite(
        raw[:count], samples.offsets, samples.counts, CONFIG.sample_step_m
    )
    loss = torch_reference.loss_per_ray(
        rendered, batch.target.to(table.dtype),
        CONFIG.alpha_weight, CONFIG.hard_surface_weight,
    ).mean()  # fmt: skip
    parts = [len(part) for part in (empty, pairs, solid, close, gaps)]
    loss = loss + FIRM_SHARE * of_close_pairs(raw[count:].split(parts)[3], close)
    density = torch.exp(raw[count:, 3].clamp(max=torch_reference.MAX_LOG_DENSITY))
    opacity = 1.0 - torch.exp(-density * OPACITY_LENGTH_M)
    of_empty, of_pairs, of_solid, *_ = opacity.split(parts)
    loss = loss + CONFIG.empty_space_weight * of_empty.mean()
    if len(gaps):
        loss = loss + CONFIG.off_skin_weight * raw[-len(gaps) :, 3].clamp(min=0.0).mean()
    loss = loss - CONFIG.interior_weight * of_solid.log().mean()
    if len(pairs) == 0:
        return loss
    one, other = of_pairs.chunk(2)
    variation = 0.2 * (one - other).abs().mean()
    return loss + variation + 0.4 * FIRM_SHARE * (of_pairs * (1.0 - of_pairs)).mean()


def of_close_pairs(raw, points):
    """Loss of close pairs: gentle edges, no excess density, even colors."""
    (one, other), (here, there) = raw.chunk(2), points.to(raw.dtype).chunk(2)
    steep = (one[:, 3] - other[:, 3]).abs() - (here - there).norm(dim=1) * 4.0 / CONFIG.finest_m
    densest = torch.maximum(one[:, 3], other[:, 3])
    loss = 0.2 * (steep.clamp(min=0.0) * (densest > 0.0)).mean()
    loss = loss + 0.2 * 0.4 * (raw[:, 3] - 6.0).clamp(min=0.0).mean()
    uneven = (torch.sigmoid(one[:, :3]) - torch.sigmoid(other[:, :3])).abs().sum(dim=1)
    return loss + 0.3 * (uneven * (densest > 2.0)).mean()


def one_step(trainer):
    """Gradients of a step, and everything random that went into it."""
    field, occupancy = trainer.avatar.field, trainer.avatar.occupancy
    batch = trainer.replay.sample_rays(CONFIG.rays, torch.Generator().manual_seed(3))
    generator = torch.Generator().manual_seed(4)
    occupancy._ahead.clear()
    field.table_grad.zero_()
    compute_gradients(
        trainer.avatar, trainer.replay.correspondences, batch, CONFIG,
        hard_surface_share=1.0, surface_share=FIRM_SHARE, generator=generator,
    )  # fmt: skip
    generator = torch.Generator().manual_seed(4)
    occupancy._ahead.clear()  # the same points are drawn once more
    seed = int(torch.randint(1 << 32, (), generator=generator))
    how = MarchSettings(CONFIG.sample_step_m, CONFIG.opaque_margin_m, CONFIG.max_samples)
    cells = trainer.replay.correspondences
    samples = operations.march(batch.rays, cells, occupancy.density_grid, how)
    empty = occupancy.sample(EMPTY_SPACE, CONFIG.empty_space_points, generator)
    pairs = radiance_field.sample_tv_pairs(samples.points, CONFIG, seed ^ TV_SEED)
    solid = occupancy.sample(INTERIOR, CONFIG.interior_points, generator)
    close = radiance_field.sample_smoothness_pairs(samples.points, CONFIG, seed ^ SMOOTHNESS_SEED)
    gaps = occupancy.sample(OFF_SKIN, CONFIG.off_skin_points, generator)
    grads = [parameter.grad.clone() for parameter in field.parameters()]
    return grads, (samples, empty, pairs, solid, close, gaps, batch)


def test_the_steps_gradient_is_that_of_autograd(trainer):
    grads, drawn = one_step(trainer)
    parameters = [p.detach().clone().requires_grad_() for p in trainer.avatar.field.parameters()]
    expected = torch.autograd.grad(mean_loss(trainer, parameters, *drawn), parameters)
    for ours, theirs in zip(grads, expected, strict=True):
        assert float((ours - theirs).abs().max()) <= 1e-5 * float(theirs.abs().max())


def test_a_frozen_field_takes_no_gradients(trainer):
    moving, _ = one_step(trainer)
    for grad in (parameter.grad for parameter in trainer.avatar.field.parameters()):
        grad.zero_()
    frozen = dataclasses.replace(trainer.avatar, field=trainer.avatar.field.frozen())
    held, _ = one_step(SimpleNamespace(avatar=frozen, replay=trainer.replay))
    assert all(grad.any() for grad in moving)
    assert not any(grad.any() for grad in held)


def test_faint_gradients_that_are_drawn_by_chance_have_the_same_mean():
    generator = torch.Generator().manual_seed(0)
    grads = torch.randn(400, 4, generator=generator) * torch.logspace(-5, 0, 400)[:, None]
    grads[7] = 0.0
    strength = grads.abs().sum(dim=1)
    faint, mean, share = np.float32(0.3 * strength.mean()), torch.zeros_like(grads), 0.0
    rows, drawn = np.empty(400, dtype=np.int64), torch.empty_like(grads)
    for seed in range(400):
        kept, total = numba_training_step._draw_strong(
            grads.numpy(), np.uint32(seed * 7919), 0, faint, rows, drawn.numpy()
        )
        mean.index_add_(0, torch.from_numpy(rows[:kept]), drawn[:kept] / 400)
        share += kept / len(grads) / 400
    assert float(total) == pytest.approx(float(strength.sum()), rel=1e-5)
    firm = strength >= float(faint)
    torch.testing.assert_close(mean[firm], grads[firm], atol=1e-5, rtol=1e-4)
    assert not mean[7].any()
    assert float(mean[~firm].sum()) == pytest.approx(float(grads[~firm].sum()), abs=0.3)
    assert 0.3 < share < 0.6


def test_half_of_the_samples_give_nearly_the_steps_whole_gradient(trainer):
    """The table's gradient, and that of the poses, of one draw against those of all samples."""
    found = []
    for share in (0.0, 0.2):
        poses = PoseOptimizer(trainer.avatar.rig, trainer.replay.capacity)
        for slot in range(4):
            poses.set_pose(slot, trainer.poses.pose(slot))
        trainer.avatar.occupancy._ahead.clear()
        trainer.field.table_grad.zero_()
        compute_gradients(
            trainer.learner, trainer.replay.correspondences,
            trainer.replay.sample_rays(CONFIG.rays, torch.Generator().manual_seed(3)),
            dataclasses.replace(CONFIG, faint_gradient_share=share), hard_surface_share=1.0,
            poses=poses, generator=torch.Generator().manual_seed(4),
        )  # fmt: skip
        pulls = torch.cat([torch.from_numpy(pose_gradient(poses, slot)) for slot in range(4)])
        found.append((trainer.field.table_grad.clone(), pulls))
    for whole, drawn in zip(*found, strict=True):
        assert not torch.equal(whole, drawn)
        alike = torch.cosine_similarity(whole.flatten(), drawn.flatten(), dim=0)
        assert float(alike) > 0.98


def test_a_step_without_samples_learns_nothing_from_its_rays(trainer):
    """Rays that miss everything: no crash, and no gradient but those of the priors."""
    occupied = trainer.avatar.occupancy.density_grid.occupied
    before = occupied.clone()
    occupied.zero_()
    (_, first, *_), drawn = one_step(trainer)
    occupied.copy_(before)
    samples, empty, pairs, _, close, _, batch = drawn
    assert isinstance(samples, RaySamples)
    assert len(samples.points) == 0
    assert torch.isfinite(first).all()
    assert len(batch.target) == CONFIG.rays
    assert len(empty) == CONFIG.empty_space_points
    assert len(pairs) == len(close) == 0


def test_the_learning_rate_falls_from_one_to_a_twentieth():
    assert cosine_decay(-1.0) == cosine_decay(0.0) == 1.0
    assert cosine_decay(0.5) == pytest.approx(0.5)
    assert cosine_decay(1.0) == cosine_decay(2.0) == 0.05


def test_samples_are_coarse_at_first_and_fine_at_last():
    config = TrainConfig(sample_step_m=0.004, initial_step_factor=3.0)
    assert config.sample_step_at(0.0) == pytest.approx(0.012)
    assert config.sample_step_at(1.0) == pytest.approx(0.004)
    assert TrainConfig(sample_step_m=0.01).sample_step_at(0.0) == 0.015
    assert TrainConfig(sample_step_m=0.02).sample_step_at(0.0) == 0.02  # never finer than stated


def slope_gradient(raw: torch.Tensor, points: torch.Tensor, weight: float) -> torch.Tensor:
    """What the prior's kernel adds to zeros, at a limit of 600 per metre."""
    grad = torch.zeros_like(raw)
    arguments = raw.numpy(), points.numpy(), np.float32(600.0), np.float32(weight)
    numba_priors.density_slope(*arguments, grad.numpy())
    return grad


def along_a_line(*logs: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Raw numbers of two points with these log densities, and where they lie, 2 mm apart."""
    raw, points = torch.zeros(2, 4), torch.zeros(2, 3)
    raw[:, 3], points[1, 2] = torch.tensor(logs), 0.002
    return raw, points


def test_a_steep_edge_flattens_to_the_limit_and_a_gentle_one_stays():
    raw, points = along_a_line(5.0, -5.0)
    for _ in range(2000):
        raw -= slope_gradient(raw, points, 0.01)
    assert float(raw[0, 3] - raw[1, 3]) == pytest.approx(1.2, abs=0.03)
    assert not slope_gradient(*along_a_line(3.0, 2.0), 0.01).any()


def test_the_slope_of_empty_space_is_not_penalised():
    assert not slope_gradient(*along_a_line(-1.0, -20.0), 1.0).any()


def test_close_pairs_are_drawn_only_if_a_prior_needs_them(generator):
    samples = torch.rand(100, 3, generator=generator)
    assert len(radiance_field.sample_smoothness_pairs(samples, TrainConfig(), 1)) == 0
    config = TrainConfig(density_slope_weight=0.1, smoothness_pairs=5000)
    one, other = radiance_field.sample_smoothness_pairs(samples, config, 1).chunk(2)
    assert float((other - one).std()) == pytest.approx(0.5 * config.finest_m, rel=0.03)


def test_pairs_lie_about_a_centimetre_apart(generator):
    config = TrainConfig(density_tv_pairs=5000)
    samples = torch.rand(100, 3, generator=generator)
    one, other = radiance_field.sample_tv_pairs(samples, config, 1).chunk(2)
    assert len(one) == config.density_tv_pairs
    assert float((other - one).std()) == pytest.approx(radiance_field.TV_PAIR_SIGMA_M, rel=0.03)
    assert (one[:, None] == samples).all(dim=2).any(dim=1).all()


@pytest.fixture
def field(levels) -> RadianceField:
    return RadianceField(levels, torch.Generator().manual_seed(3))


def filled(field, value) -> RadianceField:
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.fill_(value)
    return field


def test_a_copy_has_the_same_numbers_and_none_in_common(field):
    copied = field.clone()
    for ours, theirs in zip(copied.parameters(), field.parameters(), strict=True):
        assert torch.equal(ours, theirs)
        assert ours.data_ptr() != theirs.data_ptr()
        assert ours.grad.data_ptr() != theirs.grad.data_ptr()


def test_the_first_steps_are_followed_at_once(field):
    mean = filled(field.clone(), 0.0)
    for steps in range(1, EMA_INTERVAL + 1):
        update_ema(mean, filled(field, float(steps)), steps)
        assert all((p == steps).all() for p in mean.parameters())


def test_later_it_is_the_exponential_mean_over_the_horizon(field):
    mean, late = filled(field.clone(), 0.0), EMA_INTERVAL * 1000
    filled(field, 1.0)
    for steps in range(late, late + EMA_INTERVAL * 20):
        update_ema(mean, field, steps)
    expected = 1.0 - (1.0 - EMA_INTERVAL / EMA_HORIZON_STEPS) ** 20
    for parameter in mean.parameters():
        torch.testing.assert_close(parameter, torch.full_like(parameter, expected))


@pytest.mark.slow
def test_while_the_rate_is_high_the_mean_is_closer_to_unseen_frames_than_the_last_step(rig, clip):
    trainer, held = untaught(rig, clip)
    for _ in range(50 * trainer_module.EMA_INTERVAL):
        trainer.step(rate=1.0, hard_surface_share=1.0)
    last = dataclasses.replace(trainer.avatar, field=trainer.field)
    mean, swinging = (
        np.mean([score_frame(avatar, frame).psnr for frame in held])
        for avatar in (trainer.avatar, last)
    )
    assert mean > swinging + 0.3


WITHOUT_COMPILER = """
import sys, torch
from avatar.training.trainer import UncompiledAdam
from avatar.training.trainer import step_optimizer
numbers = torch.nn.Parameter(torch.zeros(3))
adam = UncompiledAdam([numbers])
numbers.grad = torch.ones(3)
adam.step()
numbers.grad.fill_(1.0)
step_optimizer(adam)
adam.load_state_dict(adam.state_dict())
assert numbers.max() < 0
print("torch._dynamo" in sys.modules)
"""


def test_compiled_steps_are_those_of_torch_and_spend_the_gradient():
    """Rates and eps of two groups, blocks that are not full, entries without a gradient so far."""
    generator = torch.Generator().manual_seed(0)
    start = [torch.randn(5001, 4, generator=generator), torch.randn(7, generator=generator)]
    ours, theirs = ([torch.nn.Parameter(p.clone()) for p in start] for _ in range(2))
    pair = [
        kind([{"params": p[:1], "lr": 0.01, "eps": 1e-15}, {"params": p[1:]}], betas=(0.9, 0.99))
        for p, kind in ((ours, UncompiledAdam), (theirs, torch.optim.Adam))
    ]
    for step in range(6):
        for mine, other in zip(ours, theirs, strict=True):
            grad = torch.randn(mine.shape, generator=generator)
            grad *= torch.rand(grad.shape, generator=generator) < 0.2
            other.grad = grad.clone()
            mine.grad = grad if mine.grad is None else mine.grad.copy_(grad)
        step_optimizer(pair[0])
        pair[1].step()
        assert not any(p.grad.any() for p in ours)
        if step == 3:
            pair[0].load_state_dict(pair[0].state_dict())
    for mine, other, before in zip(ours, theirs, start, strict=True):
        torch.testing.assert_close(mine, other, atol=1e-6, rtol=0)
        assert not torch.equal(mine, before)


@pytest.mark.slow
def test_a_step_and_a_checkpoint_load_no_compiler():
    root = Path(__file__).parents[3]
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_COMPILER],
        cwd=root, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.strip() == "False"

"""The running mean of the field: how far it reaches back, and what it is worth while it streams.

Our Adam takes torch's own steps, and loads no compiler for them.
"""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from avatar.evaluation.held_out import score_frame
from avatar.radiance_field import RadianceField
from avatar.training import trainer as trainer_module
from avatar.training.trainer import (
    EMA_HORIZON_STEPS,
    EMA_INTERVAL,
    UncompiledAdam,
    step_optimizer,
    update_ema,
)
from tests.avatar_fixtures import untaught


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

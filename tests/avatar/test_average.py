"""The running mean of the field: how far it reaches back, and what it is worth while it streams."""

import dataclasses

import numpy as np
import pytest
import torch

from avatar import average
from avatar.average import EMA_INTERVAL, EMA_HORIZON_STEPS, update_ema
from avatar.config import TrainConfig
from avatar.field import RadianceField
from avatar.hold import HeldOutFrame, prepare_stream, score_frame
from avatar.kernels.choice import backend_for
from avatar.trainer import Trainer

CPU = torch.device("cpu")


@pytest.fixture
def field(levels) -> RadianceField:
    return RadianceField(levels, backend_for(CPU), CPU, torch.Generator().manual_seed(3))


def filled(field, value) -> RadianceField:
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.fill_(value)
    return field


def test_a_copy_has_the_same_numbers_and_none_in_common(field):
    copied = field.copied()
    for ours, theirs in zip(copied.parameters(), field.parameters(), strict=True):
        assert torch.equal(ours, theirs)
        assert ours.data_ptr() != theirs.data_ptr()
        assert ours.grad.data_ptr() != theirs.grad.data_ptr()


def test_the_first_steps_are_followed_at_once(field):
    mean = filled(field.copied(), 0.0)
    for steps in range(1, EMA_INTERVAL + 1):
        update_ema(mean, filled(field, float(steps)), steps)
        assert all((p == steps).all() for p in mean.parameters())


def test_later_it_is_the_exponential_mean_over_the_horizon(field):
    mean, late = filled(field.copied(), 0.0), EMA_INTERVAL * 1000
    filled(field, 1.0)
    for steps in range(late, late + EMA_INTERVAL * 20):
        update_ema(mean, field, steps)
    expected = 1.0 - (1.0 - EMA_INTERVAL / EMA_HORIZON_STEPS) ** 20
    for parameter in mean.parameters():
        torch.testing.assert_close(parameter, torch.full_like(parameter, expected))


@pytest.mark.slow
def test_while_the_rate_is_high_the_mean_is_closer_to_unseen_frames_than_the_last_step(rig, clip):
    config = TrainConfig(
        rays=512, sample_step_m=0.015, finest_m=0.03, levels=6, table_size=1 << 14, refine_poses=False
    )
    trainer, held = Trainer(rig, config, CPU), []
    for item in prepare_stream(iter(clip.observations), rig, stride=6, total=None):
        if isinstance(item, HeldOutFrame):
            held.append(item)
        else:
            trainer.add_frame(item)
    for _ in range(50 * average.EMA_INTERVAL):
        trainer.step(rate=1.0, hard_surface_share=1.0)
    last = dataclasses.replace(trainer.avatar, field=trainer.field)
    mean, swinging = (
        np.mean([score_frame(avatar, frame).psnr for frame in held]) for avatar in (trainer.avatar, last)
    )
    assert mean > swinging + 0.3

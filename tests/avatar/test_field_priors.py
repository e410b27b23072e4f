"""Limits of a field's slope, and points to compare; `test_training_step` has the other priors."""

import numpy as np
import pytest
import torch

from avatar import radiance_field
from avatar.config import TrainConfig
from avatar.kernels import numba_priors


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

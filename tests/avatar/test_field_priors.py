"""Each prior of the field: its gradient, and where following it alone ends."""

import math

import numpy as np
import pytest
import torch

from avatar import radiance_field
from avatar.config import TrainConfig
from avatar.kernels import numba_priors
from avatar.kernels.numba_priors import OPACITY_LENGTH_M, opacities


def raw_of(*opacities: float) -> torch.Tensor:
    """Raw numbers of points with these opacities of a centimetre."""
    raw = torch.zeros(len(opacities), 4)
    raw[:, 3] = torch.tensor([math.log(-math.log1p(-a) / OPACITY_LENGTH_M) for a in opacities])
    return raw


def opacities_of(raw: torch.Tensor) -> list[float]:
    value, slope = torch.empty(2, len(raw))
    opacities(raw.numpy(), value.numpy(), slope.numpy())
    return value.tolist()


def gradient(prior, raw: torch.Tensor, *arguments) -> torch.Tensor:
    """What a prior's kernel adds to zeros."""
    grad = torch.zeros_like(raw)
    prior(raw.numpy(), *(np.float32(argument) for argument in arguments), grad.numpy())
    return grad


def followed(raw: torch.Tensor, prior, *, steps: int = 2000) -> list[float]:
    """Opacities after gradient descent on one prior."""
    raw = raw.clone()
    for _ in range(steps):
        raw -= gradient(prior, raw, 1.0)
    return opacities_of(raw)


def test_opacity_is_that_of_one_centimetre():
    assert opacities_of(raw_of(0.01, 0.5, 0.99)) == pytest.approx([0.01, 0.5, 0.99])


def test_the_double_well_drives_fog_apart_at_one_half():
    thin, even, thick = followed(raw_of(0.4, 0.5, 0.6), numba_priors.double_well)
    assert thin < 0.01
    assert even == pytest.approx(0.5, abs=1e-3)
    assert thick > 0.95


def test_where_a_body_is_solid_even_nothing_becomes_something():
    """Opacity's own slope is gone where there is nothing; cross-entropy's is 1."""
    raw = raw_of(1e-4)
    assert float(gradient(numba_priors.interior, raw, 1.0)[0, 3]) == pytest.approx(-1.0, abs=1e-3)
    assert -float(gradient(numba_priors.empty_space, raw, 1.0)[0, 3]) == pytest.approx(
        0.0, abs=1e-3
    )
    assert followed(raw, numba_priors.interior)[0] > 0.99


def test_emptiness_clears_fog():
    assert followed(raw_of(0.9), numba_priors.empty_space)[0] < 0.01


def test_variation_draws_a_pair_together_and_leaves_an_even_one_alone():
    thin, even, thick, same = followed(
        raw_of(0.2, 0.5, 0.8, 0.5), numba_priors.density_tv, steps=200
    )
    assert thick - thin < 0.1
    assert even == same == pytest.approx(0.5)


@pytest.mark.parametrize(
    "prior",
    [
        numba_priors.empty_space,
        numba_priors.interior,
        numba_priors.density_tv,
        numba_priors.double_well,
    ],
)
def test_priors_of_density_leave_colors_alone_and_accept_no_points(prior):
    raw = torch.randn(10, 4, generator=torch.Generator().manual_seed(0))
    assert not gradient(prior, raw, 1.0)[:, :3].any()
    assert gradient(prior, raw[:0], 1.0).shape == (0, 4)


def along_a_line(*logs: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Raw numbers of two points with these log densities, and where they lie, 2 mm apart."""
    raw, points = torch.zeros(2, 4), torch.zeros(2, 3)
    raw[:, 3], points[1, 2] = torch.tensor(logs), 0.002
    return raw, points


def test_a_steep_edge_flattens_to_the_limit_and_a_gentle_one_stays():
    raw, points = along_a_line(5.0, -5.0)
    for _ in range(2000):
        raw -= gradient(numba_priors.density_slope, raw, points, 600.0, 0.01)
    assert float(raw[0, 3] - raw[1, 3]) == pytest.approx(1.2, abs=0.03)
    raw, points = along_a_line(3.0, 2.0)
    assert not gradient(numba_priors.density_slope, raw, points, 600.0, 0.01).any()


def test_the_slope_of_empty_space_is_not_penalised():
    raw, points = along_a_line(-1.0, -20.0)
    assert not gradient(numba_priors.density_slope, raw, points, 600.0, 1.0).any()


def test_needless_density_is_penalized():
    raw, points = along_a_line(8.0, 8.0)
    for _ in range(4000):
        raw -= gradient(numba_priors.density_slope, raw, points, 600.0, 0.01)
    assert raw[:, 3].tolist() == pytest.approx([numba_priors.MAX_USEFUL_LOG_DENSITY] * 2, abs=0.01)


def test_only_the_colors_of_visible_pairs_become_even():
    raw = torch.tensor([[1.0, 0.0, -1.0, 5.0], [-1.0, 0.0, 1.0, -9.0]])
    for _ in range(2000):
        raw -= gradient(numba_priors.color_tv, raw, 0.01)
    assert float((raw[0, :3] - raw[1, :3]).abs().max()) < 0.02
    assert raw[:, 3].tolist() == [5.0, -9.0]
    raw[:, 3] = 1.0
    assert not gradient(numba_priors.color_tv, raw, 1.0).any()


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

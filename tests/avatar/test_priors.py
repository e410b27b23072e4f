"""What opacity is asked to be where no ray tells: where following each prior alone ends."""

import math

import pytest
import torch

from avatar import priors
from avatar.config import TrainConfig
from avatar.priors import OPACITY_M, Opacity


def raw_of(*opacities: float) -> torch.Tensor:
    """Raw numbers of points with these opacities of a centimetre."""
    raw = torch.zeros(len(opacities), 4)
    raw[:, 3] = torch.tensor([math.log(-math.log1p(-a) / OPACITY_M) for a in opacities])
    return raw


def followed(raw: torch.Tensor, prior, *, steps: int = 2000) -> list[float]:
    """Opacities after gradient descent on one prior."""
    raw = raw.clone()
    for _ in range(steps):
        raw -= prior(raw, 1.0)
    return Opacity.of(raw).value.tolist()


def test_opacity_is_that_of_one_centimetre():
    assert Opacity.of(raw_of(0.01, 0.5, 0.99)).value.tolist() == pytest.approx([0.01, 0.5, 0.99])


def test_the_double_well_drives_fog_apart_at_one_half():
    thin, even, thick = followed(raw_of(0.4, 0.5, 0.6), priors.double_well)
    assert thin < 0.01
    assert even == pytest.approx(0.5, abs=1e-3)
    assert thick > 0.95


def test_where_a_body_is_solid_even_nothing_becomes_something():
    """Opacity's own slope is gone where there is nothing; cross-entropy's is 1."""
    raw = raw_of(1e-4)
    assert float(priors.solidity(raw, 1.0)[0, 3]) == pytest.approx(-1.0, abs=1e-3)
    assert -float(priors.emptiness(raw, 1.0)[0, 3]) == pytest.approx(0.0, abs=1e-3)
    assert followed(raw, priors.solidity)[0] > 0.99


def test_emptiness_clears_fog():
    assert followed(raw_of(0.9), priors.emptiness)[0] < 0.01


def test_variation_draws_a_pair_together_and_leaves_an_even_one_alone():
    thin, even, thick, same = followed(raw_of(0.2, 0.5, 0.8, 0.5), priors.variation, steps=200)
    assert thick - thin < 0.1
    assert even == same == pytest.approx(0.5)


@pytest.mark.parametrize(
    "prior", [priors.emptiness, priors.solidity, priors.variation, priors.double_well]
)
def test_no_prior_asks_anything_of_colours_or_of_no_points(prior):
    raw = torch.randn(10, 4, generator=torch.Generator().manual_seed(0))
    assert not prior(raw, 1.0)[:, :3].any()
    assert prior(raw[:0], 1.0).shape == (0, 4)


def test_pairs_lie_about_a_centimetre_apart(generator):
    config = TrainConfig(variation_pairs=5000)
    samples = torch.rand(100, 3, generator=generator)
    one, other = priors.pairs(samples, config, generator).chunk(2)
    assert len(one) == config.variation_pairs
    assert float((other - one).std()) == pytest.approx(priors.APART_M, rel=0.03)
    assert (one[:, None] == samples).all(dim=2).any(dim=1).all()

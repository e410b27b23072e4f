"""Every scheme of the baselines renders the same image as our renderer."""

import numpy as np
import pytest

from baselines.instant_avatar.samplers import BaselineScheme
from baselines.instant_avatar.scheme_rendering import render_sampler, render_samples


def draw(avatar, seen, cells, **choices):
    """An image of a pose by one of the baselines' schemes."""
    sample_rays = render_sampler(avatar, seen.pose, cells, BaselineScheme(**choices))
    return render_samples(avatar, seen.pose, seen.camera, cells=cells, sample_rays=sample_rays)


def psnr_between(one, other):
    return -10.0 * np.log10(np.mean((one - other) ** 2) + 1e-12)


@pytest.mark.parametrize(
    ("choices", "least_db"),
    [
        ({"skipping": "none"}, 45.0),
        ({"skipping": "frame"}, 40.0),
        pytest.param(
            {"skipping": "canonical", "roots": "broyden"}, 33.0, marks=pytest.mark.slow
        ),  # whose kernel takes seven seconds to compile
    ],
    ids=["no skipping", "frame grid", "broyden"],
)
def test_every_scheme_renders_the_same_image(avatar, novel, choices, least_db):
    """Cells are exact to a millimetre; a step of 15 mm through a coarse field leaves the rest."""
    ours, seen, cells = novel
    theirs = draw(avatar, seen, cells, **choices)
    assert theirs[..., 3].max() > 0.99
    assert psnr_between(ours, theirs) > least_db

"""The paper's ways of rendering beside ours: the same picture."""

import numpy as np
import pytest
import torch

from avatar.evaluation.held_out import HeldOutFrame, score_rendering
from avatar.render import render
from baselines.instant_avatar.samplers import render_sampler

CPU = torch.device("cpu")


@pytest.mark.parametrize(
    ("skipping", "roots", "least_db"),
    [
        ("none", "cells", 45.0),
        ("frame", "cells", 40.0),
        ("canonical", "broyden", 33.0),
    ],
)
def test_every_scheme_draws_the_same_picture(avatar, novel, skipping, roots, least_db):
    """Cells are exact to a millimetre; a step of 15 mm through a coarse field leaves the rest."""
    ours, seen, cells = novel
    along = render_sampler(avatar, seen.pose, cells, skipping=skipping, roots=roots)
    theirs = render(avatar, seen.pose, seen.camera, cells=cells, sample_rays=along)
    assert theirs[..., 3].max() > 0.99
    assert -10.0 * np.log10(np.mean((ours - theirs) ** 2) + 1e-12) > least_db


def test_the_pictures_of_broyden_do_not_change_with_the_grid(avatar, novel):
    """Beside ours both have a haze: roots far from the skin, where nothing was ever learnt."""
    _, seen, cells = novel
    pictures = []
    for skipping in ("frame", "none"):
        along = render_sampler(avatar, seen.pose, cells, skipping=skipping, roots="broyden")
        pictures.append(render(avatar, seen.pose, seen.camera, cells=cells, sample_rays=along))
    assert -10.0 * np.log10(np.mean((pictures[0] - pictures[1]) ** 2) + 1e-12) > 35.0


def test_the_paper_s_way_of_rendering_scores_as_ours_does(avatar, novel):
    ours, seen, cells = novel
    along = render_sampler(avatar, seen.pose, cells, skipping="frame")
    theirs = render(avatar, seen.pose, seen.camera, cells=cells, sample_rays=along)
    held = HeldOutFrame(observation=seen)
    assert score_rendering(theirs, held).psnr == pytest.approx(
        score_rendering(ours, held).psnr, abs=0.3
    )


def test_our_own_scheme_is_the_renderer_s_and_a_union_is_refused(avatar, novel):
    _, seen, cells = novel
    assert render_sampler(avatar, seen.pose, cells, skipping="canonical") is None
    with pytest.raises(ValueError, match="skipping='frame'"):
        render_sampler(avatar, seen.pose, cells, skipping="union")

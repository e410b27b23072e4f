"""Scores from a sample of a frame's pixels: what they estimate, and that they can be compared."""

from dataclasses import replace

import numpy as np
import pytest

from avatar.evaluation.held_out import (
    PIXELS_PER_FRAME,
    HeldOutFrame,
    PixelSample,
    score_frame,
    score_rendering,
)
from avatar.render import render


@pytest.fixture(scope="module")
def held(clip) -> HeldOutFrame:
    return HeldOutFrame(observation=clip.observations[3])


def test_a_sample_is_small_always_the_same_and_stands_for_the_whole_image(held):
    sample = PixelSample.of(held)
    assert len(sample.places) <= PIXELS_PER_FRAME < held.observation.alpha.size
    assert sample.areas.sum() == pytest.approx(held.observation.alpha.size)
    np.testing.assert_array_equal(PixelSample.of(held).places, sample.places)


def test_pixels_alone_are_scored_like_those_of_the_whole_rendering(rig, held, learnt):
    sample, seen = PixelSample.of(held), held.observation
    whole = sample.score_rendering(render(learnt.trainer.avatar, seen.pose, seen.camera))
    alone = sample.with_correspondences(rig).score(learnt.trainer.avatar)
    assert alone.psnr == pytest.approx(whole.psnr, abs=1e-3)
    assert alone.psnr_mask == pytest.approx(whole.psnr_mask, abs=1e-3)
    assert alone.overlap == pytest.approx(whole.overlap, abs=1e-3)


def test_the_sample_estimates_the_score_of_the_whole_image(held, learnt):
    """The mean of many independent samples; a single one is less exact."""
    whole = score_frame(learnt.trainer.avatar, held)
    seen = held.observation
    picture = render(learnt.trainer.avatar, seen.pose, seen.camera)
    scores = []
    for index in range(40):
        other = replace(seen, frame=replace(seen.frame, index=index))
        sample = PixelSample.of(HeldOutFrame(observation=other))
        scores.append(sample.score_rendering(picture))

    def mean_psnr(name: str) -> float:
        errors = [10.0 ** (-0.1 * getattr(score, name)) for score in scores]
        return float(-10.0 * np.log10(np.mean(errors)))

    assert mean_psnr("psnr") == pytest.approx(whole.psnr, abs=0.3)
    assert mean_psnr("psnr_mask") == pytest.approx(whole.psnr_mask, abs=0.3)
    assert np.mean([score.overlap for score in scores]) == pytest.approx(whole.overlap, abs=0.02)


def test_a_stratum_that_is_sampled_whole_is_exact(held, learnt):
    seen = held.observation
    alpha = np.zeros_like(seen.alpha)
    alpha[20:30, 20:30] = 1.0  # fewer pixels than are sampled
    few = HeldOutFrame(observation=replace(seen, alpha=alpha))
    picture = render(learnt.trainer.avatar, seen.pose, seen.camera)
    sampled = PixelSample.of(few).score_rendering(picture)
    assert sampled.psnr_mask == pytest.approx(score_rendering(picture, few).psnr_mask, abs=1e-4)
    assert np.isnan(sampled.ssim)

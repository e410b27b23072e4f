"""The recipe follows from the waiting time, the picture's size and how exact the poses are."""

import numpy as np
import pytest

from avatar.config import COARSEST_M, ESTIMATED_POSE_PRIORS, HEAD_SIDE_M, MAX_HEAD_PX, TrainConfig


@pytest.mark.parametrize("footprint_m", [1e-4, 0.004, 0.009, 0.02, 0.5])
def test_every_recipe_can_be_built(footprint_m):
    config = TrainConfig.for_budget(60.0, footprint_m=footprint_m, pose_uncertainty=1.0)
    assert config.table_size & (config.table_size - 1) == 0
    assert 1 << 15 <= config.table_size <= 1 << 19
    assert 0.002 <= config.finest_m < COARSEST_M
    assert 0.004 <= config.sample_step_m <= 0.015


def test_detail_follows_the_pixels():
    far, near = (TrainConfig.for_budget(60.0, footprint_m=size) for size in (0.012, 0.004))
    assert near.finest_m == 0.004
    assert far.finest_m == 0.012
    assert near.sample_step_m < far.sample_step_m
    assert near.table_size >= far.table_size


def test_cells_follow_the_pixels_in_which_the_head_was_filmed_and_samples_the_others():
    reduced, filmed = (
        TrainConfig.for_budget(60.0, footprint_m=0.004, filmed_footprint_m=size)
        for size in (None, 0.0025)
    )
    assert reduced.finest_m == 0.004
    assert filmed.finest_m == 0.0025
    assert reduced.sample_step_m == filmed.sample_step_m
    tiny = TrainConfig.for_budget(
        60.0, footprint_m=0.004, filmed_footprint_m=1e-4, pose_uncertainty=1.0
    )
    head_m = HEAD_SIDE_M / MAX_HEAD_PX  # a picture of the head has no more pixels
    assert tiny.finest_m == pytest.approx(np.hypot(head_m, 0.003))


def test_poses_that_are_estimates_show_less_detail():
    exact, half, estimated = (
        TrainConfig.for_budget(60.0, footprint_m=0.004, pose_uncertainty=share)
        for share in (0.0, 0.5, 1.0)
    )
    assert exact.finest_m == 0.004
    assert estimated.finest_m == pytest.approx(0.005)  # 4 mm of a pixel, 3 of poses
    assert exact.finest_m < half.finest_m < estimated.finest_m
    assert exact.sample_step_m < half.sample_step_m < estimated.sample_step_m


@pytest.mark.parametrize("name", ESTIMATED_POSE_PRIORS)
def test_priors_of_firm_surfaces_grow_with_the_uncertainty_of_the_poses(name):
    exact, some, half = (
        getattr(TrainConfig.for_budget(60.0, footprint_m=0.004, pose_uncertainty=share), name)
        for share in (0.0, 0.25, 0.5)
    )
    assert exact == 0.0
    assert half == pytest.approx(2.0 * some)
    assert some > 0.0


def test_uncertain_poses_are_corrected_whatever_their_rays_agree_on():
    assert TrainConfig(pose_uncertainty=0.1).poses_may_be_exact
    assert not TrainConfig(pose_uncertainty=0.9).poses_may_be_exact


def test_edges_may_be_as_steep_as_the_finest_cells_are_fine():
    coarse, fine = TrainConfig(finest_m=0.008), TrainConfig(finest_m=0.004)
    assert fine.max_log_density_slope_per_m == pytest.approx(1000.0)
    assert coarse.max_log_density_slope_per_m == pytest.approx(500.0)

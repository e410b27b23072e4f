"""The recipe follows from the waiting time, the picture's size and the number of frames."""

import pytest

from avatar.config import COARSEST_M, FULL_DETAIL_FRAMES, TrainConfig


@pytest.mark.parametrize("footprint_m", [1e-4, 0.004, 0.009, 0.02, 0.5])
def test_every_recipe_can_be_built(footprint_m):
    config = TrainConfig.for_budget(60.0, footprint_m=footprint_m, frames=1)
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


def test_few_frames_determine_less_detail():
    def finest(frames):
        return TrainConfig.for_budget(60.0, footprint_m=0.004, frames=frames).finest_m

    assert finest(6) == pytest.approx(0.004 * (FULL_DETAIL_FRAMES / 6) ** 0.5)
    assert finest(6) > finest(12) > finest(24) == finest(300) == finest(None)


def test_the_fewer_the_frames_the_smoother_surfaces_are_asked_to_be():
    weights = [
        TrainConfig.for_budget(60.0, footprint_m=0.004, frames=frames).density_tv_weight
        for frames in (None, 120, 24, 12, 6)
    ]
    usual = TrainConfig().density_tv_weight
    assert weights == pytest.approx([usual, usual, usual, 2.0 * usual, 13.5 * usual])


def test_what_few_frames_ask_for_is_not_there_when_they_are_enough():
    usual = TrainConfig.for_budget(60.0, footprint_m=0.004)
    for frames in (24, 25, 1000):
        assert TrainConfig.for_budget(60.0, footprint_m=0.004, frames=frames) == usual
    dozen = TrainConfig.for_budget(60.0, footprint_m=0.004, frames=12)
    assert dozen.double_well_weight == dozen.interior_weight == dozen.inner_leg_weight == 0.0
    assert dozen.density_slope_weight == dozen.color_tv_weight == dozen.min_occupied_density == 0.0
    assert dozen.initial_density_tv_factor == 1.0
    assert usual.double_well_weight == usual.interior_weight == 0.0
    assert (
        usual.density_tv_weight_at(0.0)
        == usual.density_tv_weight_at(1.0)
        == usual.density_tv_weight
    )


def test_surfaces_are_smoothest_at_first():
    few = TrainConfig.for_budget(60.0, footprint_m=0.004, frames=8)
    weights = [few.density_tv_weight_at(share) for share in (0.0, 0.5, 1.0)]
    assert weights[2] == few.density_tv_weight < weights[1] < weights[0]
    assert weights[0] == pytest.approx(1.5**3 * few.density_tv_weight)


def test_edges_may_be_as_steep_as_the_finest_cells_are_fine():
    coarse, fine = TrainConfig(finest_m=0.008), TrainConfig(finest_m=0.004)
    assert (
        fine.max_log_density_slope_per_m
        == 2.0 * coarse.max_log_density_slope_per_m
        == pytest.approx(1000.0)
    )

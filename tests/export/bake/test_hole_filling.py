"""Holes between surfels of stretched skin are filled, and gaps between limbs far away are not."""

import numpy as np
import pytest

from export.bake.reference_geometry import SurfelFootprints, fill_holes, z_buffer
from export.package.player_tables import DEPTH_CODES, SURFEL_BITS, RenderSettings

SIZE_PX, REACH_M = (24, 20), 1.0


def filled_share(gap_px, *, side, spacing_px):
    """Share of a gap between two sheets, far before what it shows, that is filled."""
    width, height = SIZE_PX
    empty = np.zeros(0, dtype=np.int64)
    splats = SurfelFootprints(spacing_px, side, empty, empty, np.zeros(0, dtype=np.float32))
    keys = z_buffer(SIZE_PX, splats)
    behind = int((RenderSettings().hole_depth_m + 0.02) / 2.0 * DEPTH_CODES)
    keys[:] = 0
    left = splats.margin + width // 2 - gap_px // 2
    keys[:, left : left + gap_px] = behind << SURFEL_BITS
    shown = fill_holes(keys, REACH_M, RenderSettings(), splats)
    assert shown.shape == (height, width)
    start = left - splats.margin
    return float((shown[:, start : start + gap_px] == 0).mean())


@pytest.mark.parametrize("gap_px", [4, 8, 12])
def test_holes_of_up_to_three_spacings_are_filled_in_close_ups(gap_px):
    assert filled_share(gap_px, side=5, spacing_px=4.2) == 1.0


def test_wider_gaps_are_gaps():
    assert filled_share(14, side=2, spacing_px=1.9) == 0.0


def test_far_away_a_gap_is_not_filled_by_what_a_footprint_is_rounded_up_to():
    assert filled_share(5, side=2, spacing_px=0.2) == 0.0
    assert filled_share(2, side=2, spacing_px=0.2) == 1.0

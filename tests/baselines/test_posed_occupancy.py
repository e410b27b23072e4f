"""The paper's occupancy grids: what they hold, forget and renew."""

import torch

from baselines.instant_avatar.posed_occupancy import (
    threshold_and_dilate,
)


def test_a_full_cell_fills_its_neighbours_and_nothing_else():
    density = torch.zeros(9, 9, 9)
    density[4, 4, 4] = 100.0
    occupied = threshold_and_dilate(density)
    assert int(occupied.sum()) == 27
    assert occupied[3:6, 3:6, 3:6].all()
    assert int(threshold_and_dilate(torch.zeros(9, 9, 9)).sum()) == 0

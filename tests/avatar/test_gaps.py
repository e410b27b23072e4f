"""ResectionResult the legs, off the skin: where few photographs leave webs."""

import numpy as np
import torch

from avatar.gaps import OFF_SKIN_M, inner_leg_cells
from avatar.occupancy import OccupancyGrid


def cell_at(rig, point):
    cells = np.array(rig.distance.shape)
    place = ((point - rig.box_low) / (rig.box_high - rig.box_low) * cells).astype(int)
    return int(np.ravel_multi_index(place, rig.distance.shape))


def knees(rig):
    """Where they are in canonical space."""
    return [rig.seeds[rig.seed_weights.argmax(axis=1) == joint].mean(axis=0) for joint in (4, 5)]


def test_the_middle_of_the_knees_is_between_legs_and_what_is_before_or_beside_them_is_not(rig):
    left, right = knees(rig)
    middle = 0.5 * (left + right)
    ahead, beside = left + np.array([0.0, 0.0, 0.14]), left + (left - right) * 0.7
    cells = np.array([cell_at(rig, point) for point in (middle, ahead, beside)])
    np.testing.assert_array_equal(inner_leg_cells(rig, cells), [True, False, False])


def test_nothing_near_the_skin_or_under_it_is_between_legs(rig):
    cells = np.flatnonzero(rig.distance <= 0.08)
    found = cells[inner_leg_cells(rig, cells)]
    assert 0.01 * len(cells) < len(found) < 0.2 * len(cells)
    assert rig.distance.reshape(-1)[found].min() > OFF_SKIN_M
    assert not rig.inside.reshape(-1)[found].any()


def test_points_are_drawn_between_the_legs(rig, generator):
    occupancy = OccupancyGrid(rig, torch.device("cpu"))
    points = occupancy.sample_inner_leg(200, generator).numpy()
    cells = np.array([cell_at(rig, point) for point in points])
    assert len(points) == 200
    assert inner_leg_cells(rig, cells).all()

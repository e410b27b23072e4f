"""Occupancy: what is dense stays, what is empty goes, thin surfaces are not forgotten."""

import math

import numpy as np
import pytest
import torch

from avatar.kernels.operands import EMPTY_SPACE, HEAD_INTERIOR, INTERIOR, OFF_SKIN
from avatar.occupancy_grid import (
    MIN_STEP_OPACITY,
    OccupancyGrid,
    dilate,
    find_floaters,
)
from avatar.rig import CLOTHING_BAND_M
from preprocess.body.kinematics import HEAD_JOINT

STEP_M = 0.01


@pytest.fixture
def occupancy(rig):
    return OccupancyGrid(rig)


def shell_at(rig, *, thickness_m):
    """A log density that is high in a thin sheet across the chest and nothing elsewhere."""
    middle = float(rig.rest_joints[6, 2]) + 0.05

    def log_density_at(points):
        return torch.where((points[:, 2] - middle).abs() < thickness_m / 2, 6.0, -20.0)

    return log_density_at, middle


def run(occupancy, log_density_at, generator, updates, **kwargs):
    for _ in range(updates):
        occupancy.update(
            log_density_at, share=0.25, sample_step_m=STEP_M, generator=generator, **kwargs
        )


def test_empty_space_is_given_up(occupancy, generator):
    run(occupancy, lambda points: torch.full_like(points[:, 0], -20.0), generator, 40)
    dense = occupancy.density_grid.density > MIN_STEP_OPACITY / STEP_M
    assert not dense.any()


def test_a_sheet_thinner_than_a_cell_is_never_forgotten(rig, occupancy, generator):
    """One probe a cell often misses it; an EMA that decays fast lost it (15 dB)."""
    log_density_at, middle = shell_at(rig, thickness_m=0.005)
    run(occupancy, log_density_at, generator, 60)
    cell = int((middle - rig.box_low[2]) * occupancy.density_grid.cells_per_m[2])
    sheet = (rig.skin_distance <= 0.08)[:, :, cell]
    for _ in range(60):
        run(occupancy, log_density_at, generator, 1)
        held = occupancy.density_grid.occupied[:, :, cell].bool().numpy()[sheet]
        assert held.mean() > 0.99


def test_everything_near_the_skin_is_occupied_at_first_and_nothing_ever_far_from_it(
    rig, occupancy, generator
):
    near = torch.from_numpy(rig.skin_distance <= 0.08)
    assert torch.equal(occupancy.density_grid.occupied.bool(), near)
    run(occupancy, lambda points: torch.full_like(points[:, 0], 5.0), generator, 30)
    assert not occupancy.density_grid.occupied[~near].any()


def test_empty_points_follow_every_change_of_the_occupancy(rig, occupancy, generator):
    occupied = occupancy.density_grid.occupied
    occupied.zero_()
    points = occupancy.sample(EMPTY_SPACE, 100, generator)
    cell = ((points - occupancy.density_grid.low) * occupancy.density_grid.cells_per_m).long()
    assert (rig.skin_distance[tuple(cell.T.numpy())] <= 0.08).all()
    occupied.fill_(1)
    assert len(occupancy.sample(EMPTY_SPACE, 100, generator)) == 0
    occupied.view(-1)[occupancy.band_cells[7]] = 0
    points = occupancy.sample(EMPTY_SPACE, 100, generator)
    cell = ((points - occupancy.density_grid.low) * occupancy.density_grid.cells_per_m).long()
    assert len(points) == 100
    assert not occupied[tuple(cell.T)].any()
    run(occupancy, lambda at: torch.full_like(at[:, 0], 5.0), generator, 60)
    assert len(occupancy.sample(EMPTY_SPACE, 100, generator)) == 0


def test_haze_below_the_minimum_density_counts_as_empty(occupancy, generator):
    def haze(at):
        return torch.full_like(at[:, 0], math.log(30.0))

    run(occupancy, haze, generator, 60, min_density=20.0)
    assert occupancy.density_grid.occupied.view(-1)[occupancy.band_cells].all()
    run(occupancy, haze, generator, 60, min_density=40.0)
    assert not occupancy.density_grid.occupied.any()


def test_growing_adds_the_six_neighbours():
    one = torch.zeros(5, 5, 5, dtype=torch.uint8)
    one[2, 2, 2] = 1
    assert int(dilate(one).sum()) == 7
    corner = torch.zeros(3, 3, 3, dtype=torch.uint8)
    corner[0, 0, 0] = 1
    assert int(dilate(corner).sum()) == 4


def test_specks_go_and_pieces_near_the_skin_stay():
    firm = torch.zeros(40, 40, 40, dtype=torch.bool)
    firm[:10] = True  # the body
    firm[20:22, 20:30, 20:30] = True  # a foot without contact: 200 of 16,000 cells, on the skin
    firm[30:33, 5:15, 5:15] = True  # as large, off the skin
    firm[15, 35, 35] = True  # a speck
    near_skin = np.ones(firm.shape, dtype=bool)
    near_skin[28:] = False
    gone = find_floaters(firm, near_skin).bool()
    assert not gone[firm][: 10 * 1600].any()
    assert not gone[20:22, 20:30, 20:30].any()
    assert gone[30:33, 5:15, 5:15].all()
    assert gone[15, 35, 35]
    assert gone[15, 35, 37]  # and the haze around it
    assert not gone[12].any()  # but not what is nearer to the body
    firm[10:] = False
    assert not find_floaters(firm, near_skin).any()


def test_solid_points_lie_deep_under_the_skin(rig, occupancy, generator):
    points = occupancy.sample(INTERIOR, 500, generator)
    cell = ((points - occupancy.density_grid.low) * occupancy.density_grid.cells_per_m).long()
    assert len(points) == 500
    assert rig.inside_skin[tuple(cell.T.numpy())].all()
    assert (rig.skin_distance[tuple(cell.T.numpy())] > 0.015).all()


def test_points_off_the_skin_are_where_no_clothes_are(rig, generator):
    occupancy = OccupancyGrid(rig)
    points = occupancy.sample(OFF_SKIN, 500, generator)
    cell = ((points - occupancy.density_grid.low) * occupancy.density_grid.cells_per_m).long()
    distance = rig.skin_distance[tuple(cell.T.numpy())]
    assert len(points) == 500
    assert ((distance > 0.03) & (distance <= CLOTHING_BAND_M)).all()
    assert not rig.inside_skin[tuple(cell.T.numpy())].any()


def test_the_heads_interior_lies_in_the_head(rig, generator):
    points = OccupancyGrid(rig).sample(HEAD_INTERIOR, 200, generator).numpy()
    assert len(points) == 200
    assert (rig.weights_at(points).argmax(axis=1) == HEAD_JOINT).mean() > 0.95
    assert points[:, 1].min() > rig.rest_joints[HEAD_JOINT, 1] - 0.1


def test_a_face_is_empty_before_its_skin_until_it_is_given_other_cells(rig, generator):
    occupancy = OccupancyGrid(rig)
    cells = occupancy.band_cells
    before, under = cells[::50], cells[1::50]
    occupancy.shape_face(before, under)
    run(occupancy, lambda points: torch.full((len(points),), 6.0), generator, 8)
    occupied = occupancy.density_grid.occupied.view(-1)
    assert not occupied[before].any()
    assert occupied[under].float().mean() > 0.9
    grid, drawn = occupancy.density_grid, occupancy.sample(HEAD_INTERIOR, 500, generator)
    place = ((drawn - grid.low) * grid.cells_per_m).long().numpy().T
    flat = np.ravel_multi_index(tuple(place), tuple(grid.occupied.shape))
    assert np.isin(flat, under.numpy()).mean() > 0.3
    occupancy.shape_face(cells[:0], cells[:0])
    run(occupancy, lambda points: torch.full((len(points),), 6.0), generator, 8)
    assert occupied[before].float().mean() > 0.9

"""The paper's occupancy grids: what they hold, forget and renew."""

import torch

from avatar.correspondence_grid import CorrespondenceGrid
from avatar.render import correspondence_tables
from baselines.instant_avatar.posed_field import CorrespondenceWarp, PosedField
from baselines.instant_avatar.posed_occupancy import (
    PerFrameGrids,
    SequenceGrid,
    threshold_and_dilate,
)


def holds(grid, slot, points):
    """Share of a slot's points that lie in occupied cells of a posed grid."""
    cell = ((points - grid.low[slot]) * grid.cells_per_m[slot]).long()
    _, ny, nz = grid.shape[slot].tolist()
    flat = (cell[:, 0] * ny + cell[:, 1]) * nz + cell[:, 2]
    assert ((cell >= 0) & (cell < grid.shape[slot])).all()
    return float((grid.occupied[slot, flat] != 0).float().mean())


def test_a_full_cell_fills_its_neighbours_and_nothing_else():
    density = torch.zeros(9, 9, 9)
    density[4, 4, 4] = 100.0
    occupied = threshold_and_dilate(density)
    assert int(occupied.sum()) == 27
    assert occupied[3:6, 3:6, 3:6].all()
    assert int(threshold_and_dilate(torch.zeros(9, 9, 9)).sum()) == 0


def test_the_union_holds_what_every_frame_holds(learnt, avatar, generator, solid_in):
    replay = learnt.trainer.replay
    field = PosedField(avatar.field, CorrespondenceWarp(avatar.field, avatar.occupancy))
    union = SequenceGrid(avatar.rig, field, interval=16)
    for slot in range(len(replay)):
        union.probe(slot, replay.correspondences, generator)
    frames = PerFrameGrids(field, 1)
    assert 0.01 < float(union.occupied.float().mean()) < 0.2
    for slot in range(0, len(replay), 5):
        solid = solid_in(avatar, learnt.trainer.poses.pose(slot))
        assert holds(union.posed_occupancy(replay.correspondences), slot, solid) > 0.999
        rotations = learnt.trainer.poses.pose(slot).joint_rotations
        tables = correspondence_tables(CorrespondenceGrid.solve(avatar.rig, rotations))
        frames.add_frame(0, tables)
        for _ in range(5):
            frames.probe(0, tables, generator)
        assert holds(frames.posed_occupancy(tables), 0, solid) > 0.999
        # every point of the frame's own grid is in the union, give or take a coarse cell's width
        cell = frames.occupied[0].nonzero() + 0.5
        centers = cell / frames.posed_occupancy(tables).cells_per_m[0] + tables.low[0]
        assert holds(union.posed_occupancy(replay.correspondences), slot, centers) > 0.98

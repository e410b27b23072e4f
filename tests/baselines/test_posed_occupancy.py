"""The paper's occupancy grids: what they hold, forget and renew."""

import numpy as np
import pytest
import torch

from avatar.config import TrainConfig
from avatar.correspondence_grid import CorrespondenceGrid
from avatar.render import correspondence_tables
from avatar.training.trainer import Trainer
from baselines.instant_avatar.posed_field import CanonicalPoints, CorrespondenceWarp, PosedField
from baselines.instant_avatar.posed_occupancy import (
    GRID_DECAY,
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


def test_a_cell_counts_from_a_hundredth_of_opacity_in_a_centimetre_or_the_mean():
    density = torch.full((9, 9, 9), 50.0)  # the mean is far above a hundredth
    density[4, 4, 4] = 0.0
    alone = density.clone()
    alone[3:6, 3:6, 3:6] = 0.99  # opacity 0.00985
    assert not threshold_and_dilate(alone)[4, 4, 4]
    alone[3:6, 3:6, 3:6] = 1.02
    assert threshold_and_dilate(alone)[4, 4, 4]
    faint = torch.zeros(9, 9, 9)  # here the mean is the bar
    faint[4, 4, 4] = 0.5
    assert int(threshold_and_dilate(faint).sum()) == 27


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


class Nowhere:
    """A warp that leaves every point where it is."""

    def __call__(self, points, slots, cells):
        found = torch.ones(len(points), dtype=torch.bool)
        return CanonicalPoints(points, torch.zeros(len(points), dtype=torch.int32), found)

    def set_pose(self, slot, bones):
        pass


@pytest.fixture
def fog(rig):
    """A posed field of one density, and the function that sets it."""
    config = TrainConfig(levels=2, table_size=1 << 10)
    field = Trainer(rig, config).avatar.field

    def thicken(density):
        with torch.no_grad():
            field.layers[2].zero_()
            field.layers[3][3] = float(np.log(density))

    return PosedField(field, Nowhere()), thicken


def of_slot(frames, slot):
    """The one density of a slot's cells."""
    assert float(frames.density[slot].max() - frames.density[slot].min()) == 0.0
    return pytest.approx(float(frames.density[slot, 0, 0, 0]), rel=1e-4)


def test_a_grid_forgets_at_the_paper_s_rate_and_keeps_the_highest(fog, learnt, generator):
    cells, (field, thicken) = learnt.trainer.replay.correspondences, fog
    frames = PerFrameGrids(field, 1)
    frames.add_frame(0, cells)
    assert frames.occupied.all()  # until it has been probed
    kept = 0.0
    for step, density in ((0, 100.0), (4, 90.0), (8, 1e-6), (12, 1e-6)):
        thicken(density)
        frames.update(step, cells, generator)
        kept = max(GRID_DECAY * kept, density)
        assert of_slot(frames, 0) == kept
    thicken(100.0)
    frames.update(13, cells, generator)  # not yet its turn
    assert of_slot(frames, 0) == kept


def test_the_frame_whose_grid_is_oldest_is_renewed_first(fog, learnt, generator):
    cells, (field, thicken) = learnt.trainer.replay.correspondences, fog
    frames = PerFrameGrids(field, 3)
    for slot in (0, 1, 2):
        frames.add_frame(slot, cells)
    thicken(1.0)
    for step in (0, 4, 8):
        frames.update(step, cells, generator)
    assert [of_slot(frames, slot) for slot in range(3)] == [1.0, 1.0, 1.0]
    thicken(5.0)
    frames.add_frame(1, cells)  # another frame took the slot: it is new
    assert frames.occupied[1].all()
    frames.update(12, cells, generator)
    assert [of_slot(frames, slot) for slot in range(3)] == [1.0, 5.0, 1.0]


def test_empty_points_are_empty_in_the_pose_that_was_probed(learnt, avatar, generator):
    """What a grid calls empty has hardly any density, and is drawn from all over the band."""
    warp = CorrespondenceWarp(avatar.field, avatar.occupancy)
    union = SequenceGrid(avatar.rig, PosedField(avatar.field, warp), interval=16)
    assert len(union.sample_empty(10, generator)) == 0
    for slot in range(4):
        union.probe(slot, learnt.trainer.replay.correspondences, generator)
    empty = union.sample_empty(2000, generator)
    assert len(empty) == 2000
    density = torch.exp(avatar.field.raw_outputs_at(empty)[:, 3])
    assert float(density.max()) < 1.5
    low, high = torch.from_numpy(avatar.rig.box_low), torch.from_numpy(avatar.rig.box_high)
    spread = (empty.amax(0) - empty.amin(0)) / (high - low)
    assert float(spread.min()) > 0.6

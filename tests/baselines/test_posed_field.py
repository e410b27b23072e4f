"""The paper's warp beside ours: which root counts, and who asks for one."""

import torch

from avatar.render import correspondence_tables
from baselines.instant_avatar.broyden_kernels import find_all_roots
from baselines.instant_avatar.posed_field import BroydenWarp


def test_of_several_roots_the_densest_counts(rig, avatar, novel, generator, bones_of):
    """The paper's maximum over all roots, asked of the field one by one."""
    _, seen, cells = novel
    warp = BroydenWarp(avatar.field, rig, 1)
    warp.set_pose(0, bones_of(rig, seen.pose))
    low = torch.from_numpy(cells.low)
    size = torch.tensor(cells.packed_cells.shape) * cells.cell_m
    points = low + torch.rand(4000, 3, generator=generator) * size
    slots = torch.zeros(4000, dtype=torch.int32)
    warped = warp(points, slots, correspondence_tables(cells))
    roots, valid = find_all_roots(points, slots, warp.poses)
    box = [torch.from_numpy(corner) for corner in (rig.box_low, rig.box_high)]
    valid &= ((roots >= box[0]) & (roots <= box[1])).all(dim=-1)
    score = torch.full(valid.shape, -torch.inf)
    score[valid] = avatar.field.raw_outputs_at(roots[valid])[:, 3]
    assert torch.equal(warped.has_root, valid.any(dim=1))
    assert (valid.sum(dim=1) > 1).sum() > 40
    chosen = avatar.field.raw_outputs_at(warped.points)[:, 3]
    torch.testing.assert_close(chosen, score.amax(dim=1)[warped.has_root], atol=1e-5, rtol=0)

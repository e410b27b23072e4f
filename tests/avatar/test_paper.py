"""The paper's schemes beside ours: where they must agree, what they promise, that they learn."""

import dataclasses

import numpy as np
import pytest
import torch

from avatar.cells import WarpCells
from avatar.config import TrainConfig
from avatar.hold import compared
from avatar.kernels.backend import Marching
from avatar.occupancy import FIRM_DENSITY
from avatar.paper.emptiness import NothingKnown
from avatar.paper.grids import DECAY, FrameGrids, UnionGrid, occupied_by
from avatar.paper.posed_field import PosedField
from avatar.paper.sampler import PosedSampler
from avatar.paper.variants import rendering, sampler_for
from avatar.paper.warp import BroydenWarp, CellWarp, Warped
from avatar.prepare import prepare
from avatar.refine import PoseTable
from avatar.render import cell_tables, render
from avatar.replay import Replay
from avatar.step import gradients
from avatar.trainer import Trainer

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def avatar(learnt):
    return learnt.trainer.avatar


@pytest.fixture(scope="module")
def novel(learnt):
    """The novel pose's picture by the exact renderer, and what it is a picture of."""
    seen = learnt.novel.observation
    picture = render(learnt.trainer.avatar, seen.pose, seen.camera, cells=learnt.novel.cells)
    return picture, seen, learnt.novel.cells


def bones_of(rig, pose):
    bones = rig.body_from_canonical(pose.joint_rotations)[:, :3].reshape(24, 12)
    return torch.from_numpy(bones.astype(np.float32))


def solid_in(avatar, pose):
    """Where skinning carries the centres of dense canonical cells, body frame."""
    grid = avatar.occupancy.grid
    cells = (grid.density > FIRM_DENSITY).nonzero()
    points = ((cells + 0.5) / grid.cells_per_m + grid.low).numpy()
    matrix = (avatar.rig.weights_at(points) @ bones_of(avatar.rig, pose).numpy()).reshape(-1, 3, 4)
    carried = (matrix[..., :3] @ points[..., None])[..., 0] + matrix[..., 3]
    return torch.from_numpy(carried.astype(np.float32))


def holds(grid, slot, points):
    """Share of a slot's points that lie in occupied cells of a posed grid."""
    cell = ((points - grid.low[slot]) * grid.cells_per_m[slot]).long()
    _, ny, nz = grid.shape[slot].tolist()
    flat = (cell[:, 0] * ny + cell[:, 1]) * nz + cell[:, 2]
    assert ((cell >= 0) & (cell < grid.shape[slot])).all()
    return float((grid.occupied[slot, flat] != 0).float().mean())


# --- rendering --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("skipping", "roots", "least_db"),
    [
        ("none", "cells", 45.0),
        ("frame", "cells", 40.0),
        ("canonical", "broyden", 33.0),
    ],
)
def test_every_scheme_draws_the_same_picture(avatar, novel, skipping, roots, least_db):
    """Cells are exact to a millimetre; a step of 15 mm through a coarse field leaves the rest."""
    ours, seen, cells = novel
    along = rendering(avatar, seen.pose, cells, skipping=skipping, roots=roots)
    theirs = render(avatar, seen.pose, seen.camera, cells=cells, samples_along=along)
    assert theirs[..., 3].max() > 0.99
    assert -10.0 * np.log10(np.mean((ours - theirs) ** 2) + 1e-12) > least_db


def test_the_pictures_of_broyden_do_not_change_with_the_grid(avatar, novel):
    """Beside ours both have a haze: roots far from the skin, where nothing was ever learnt."""
    _, seen, cells = novel
    pictures = []
    for skipping in ("frame", "none"):
        along = rendering(avatar, seen.pose, cells, skipping=skipping, roots="broyden")
        pictures.append(render(avatar, seen.pose, seen.camera, cells=cells, samples_along=along))
    assert -10.0 * np.log10(np.mean((pictures[0] - pictures[1]) ** 2) + 1e-12) > 35.0


def test_the_paper_s_way_of_rendering_scores_as_ours_does(avatar, novel):
    ours, seen, cells = novel
    along = rendering(avatar, seen.pose, cells, skipping="frame")
    theirs = render(avatar, seen.pose, seen.camera, cells=cells, samples_along=along)
    assert compared(theirs, seen).psnr == pytest.approx(compared(ours, seen).psnr, abs=0.3)


def test_our_own_scheme_is_the_renderer_s_and_a_union_is_refused(avatar, novel):
    _, seen, cells = novel
    assert rendering(avatar, seen.pose, cells, skipping="canonical") is None
    with pytest.raises(ValueError, match="skipping='frame'"):
        rendering(avatar, seen.pose, cells, skipping="union")


# --- grids ------------------------------------------------------------------------------------


def test_a_full_cell_fills_its_neighbours_and_nothing_else():
    density = torch.zeros(9, 9, 9)
    density[4, 4, 4] = 100.0
    occupied = occupied_by(density)
    assert int(occupied.sum()) == 27
    assert occupied[3:6, 3:6, 3:6].all()
    assert int(occupied_by(torch.zeros(9, 9, 9)).sum()) == 0


def test_a_cell_counts_from_a_hundredth_of_opacity_in_a_centimetre_or_the_mean():
    density = torch.full((9, 9, 9), 50.0)  # the mean is far above a hundredth
    density[4, 4, 4] = 0.0
    alone = density.clone()
    alone[3:6, 3:6, 3:6] = 0.99  # opacity 0.00985
    assert not occupied_by(alone)[4, 4, 4]
    alone[3:6, 3:6, 3:6] = 1.02
    assert occupied_by(alone)[4, 4, 4]
    faint = torch.zeros(9, 9, 9)  # here the mean is the bar
    faint[4, 4, 4] = 0.5
    assert int(occupied_by(faint).sum()) == 27


def test_the_union_holds_what_every_frame_holds(learnt, avatar, generator):
    replay = learnt.trainer.replay
    field = PosedField(avatar.field, CellWarp(avatar.field, avatar.occupancy))
    union = UnionGrid(avatar.rig, field, every=16, device=CPU)
    for slot in range(len(replay)):
        union.probe(slot, replay.cells, generator)
    frames = FrameGrids(field, 1, CPU)
    assert 0.01 < float(union.occupied.float().mean()) < 0.2
    for slot in range(0, len(replay), 5):
        solid = solid_in(avatar, learnt.trainer.poses.pose(slot))
        assert holds(union.grid(replay.cells), slot, solid) > 0.999
        rotations = learnt.trainer.poses.pose(slot).joint_rotations
        tables = cell_tables(WarpCells.of(avatar.rig, rotations), CPU)
        frames.admit(0, tables)
        for _ in range(5):
            frames.probe(0, tables, generator)
        assert holds(frames.grid(tables), 0, solid) > 0.999
        # every point of the frame's own grid is in the union, give or take a coarse cell's width
        cell = frames.occupied[0].nonzero() + 0.5
        centers = cell / frames.grid(tables).cells_per_m[0] + tables.low[0]
        assert holds(union.grid(replay.cells), slot, centers) > 0.98


class Nowhere:
    """A warp that leaves every point where it is."""

    def __call__(self, points, slots, cells):
        found = torch.ones(len(points), dtype=torch.bool)
        return Warped(points, torch.zeros(len(points), dtype=torch.int32), found)

    def admit(self, slot, bones):
        pass


@pytest.fixture
def fog(rig):
    """A posed field of one density, and the function that sets it."""
    config = TrainConfig(levels=2, table_size=1 << 10)
    field = Trainer(rig, config, CPU).avatar.field

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
    cells, (field, thicken) = learnt.trainer.replay.cells, fog
    frames = FrameGrids(field, 1, CPU)
    frames.admit(0, cells)
    assert frames.occupied.all()  # until it has been probed
    kept = 0.0
    for step, density in ((0, 100.0), (4, 90.0), (8, 1e-6), (12, 1e-6)):
        thicken(density)
        frames.update(step, cells, generator)
        kept = max(DECAY * kept, density)
        assert of_slot(frames, 0) == kept
    thicken(100.0)
    frames.update(13, cells, generator)  # not yet its turn
    assert of_slot(frames, 0) == kept


def test_the_frame_whose_grid_is_oldest_is_renewed_first(fog, learnt, generator):
    cells, (field, thicken) = learnt.trainer.replay.cells, fog
    frames = FrameGrids(field, 3, CPU)
    for slot in (0, 1, 2):
        frames.admit(slot, cells)
    thicken(1.0)
    for step in (0, 4, 8):
        frames.update(step, cells, generator)
    assert [of_slot(frames, slot) for slot in range(3)] == [1.0, 1.0, 1.0]
    thicken(5.0)
    frames.admit(1, cells)  # another frame took the slot: it is new
    assert frames.occupied[1].all()
    frames.update(12, cells, generator)
    assert [of_slot(frames, slot) for slot in range(3)] == [1.0, 5.0, 1.0]


def test_empty_points_are_empty_in_the_pose_that_was_probed(learnt, avatar, generator):
    """What a grid calls empty has hardly any density, and is drawn from all over the band."""
    warp = CellWarp(avatar.field, avatar.occupancy)
    union = UnionGrid(avatar.rig, PosedField(avatar.field, warp), every=16, device=CPU)
    assert len(union.empty_points(10, generator)) == 0
    for slot in range(4):
        union.probe(slot, learnt.trainer.replay.cells, generator)
    empty = union.empty_points(2000, generator)
    assert len(empty) == 2000
    density = torch.exp(avatar.field.raw_at(empty)[:, 3])
    assert float(density.max()) < 1.5
    low, high = torch.from_numpy(avatar.rig.box_low), torch.from_numpy(avatar.rig.box_high)
    spread = (empty.amax(0) - empty.amin(0)) / (high - low)
    assert float(spread.min()) > 0.6


# --- warps ------------------------------------------------------------------------------------


def test_of_several_roots_the_densest_counts(rig, avatar, novel, generator):
    """The paper's maximum over all roots, asked of the field one by one."""
    _, seen, cells = novel
    warp = BroydenWarp(avatar.field, rig, 1)
    warp.admit(0, bones_of(rig, seen.pose))
    low = torch.from_numpy(cells.low)
    size = torch.tensor(cells.index.shape) * cells.cell_m
    points = low + torch.rand(4000, 3, generator=generator) * size
    slots = torch.zeros(4000, dtype=torch.int32)
    warped = warp(points, slots, cell_tables(cells, CPU))
    roots, valid = avatar.field.backend.find_roots(points, slots, warp.poses)
    box = [torch.from_numpy(corner) for corner in (rig.box_low, rig.box_high)]
    valid &= ((roots >= box[0]) & (roots <= box[1])).all(dim=-1)
    score = torch.full(valid.shape, -torch.inf)
    score[valid] = avatar.field.raw_at(roots[valid])[:, 3]
    assert torch.equal(warped.found, valid.any(dim=1))
    assert (valid.sum(dim=1) > 1).sum() > 40
    chosen = avatar.field.raw_at(warped.points)[:, 3]
    torch.testing.assert_close(chosen, score.amax(dim=1)[warped.found], atol=1e-5, rtol=0)


def test_both_warps_agree_on_the_person(rig, avatar, novel):
    _, seen, cells = novel
    points = solid_in(avatar, seen.pose)
    slots = torch.zeros(len(points), dtype=torch.int32)
    broyden = BroydenWarp(avatar.field, rig, 1, kept_in=avatar.occupancy.grid)
    broyden.admit(0, bones_of(rig, seen.pose))
    tables = cell_tables(cells, CPU)
    exact, ours = (warp(points, slots, tables)
                   for warp in (broyden, CellWarp(avatar.field, avatar.occupancy)))  # fmt: skip
    both = exact.found & ours.found
    assert float(both.float().mean()) > 0.99
    places = [torch.zeros_like(points) for _ in range(2)]
    places[0][exact.found], places[1][ours.found] = exact.points, ours.points
    gap = (places[0] - places[1])[both].norm(dim=1)
    assert float((gap < 2e-3).float().mean()) > 0.97


def test_samples_know_which_root_warped_them(avatar, learnt, generator):
    """Through its row each sample leads back into its cell: x = x* + J⁻¹ (p - center)."""
    replay, backend = learnt.trainer.replay, avatar.field.backend
    rays = replay.draw(200, generator).rays
    sampler = PosedSampler(
        backend, NothingKnown(), CellWarp(avatar.field, avatar.occupancy), avatar.step_m
    )
    samples = sampler.samples(rays, replay.cells)
    slot = rays.slots.long().repeat_interleave(samples.count)
    root = replay.cells.roots[slot, samples.rows.long()]
    inverse = root[:, 3:].unflatten(1, (3, 3))
    offset = torch.linalg.solve(inverse, samples.points - root[:, :3])
    assert (
        float((offset.abs().amax(dim=1) < 0.5 * replay.cells.cell_m + 1e-3).float().mean()) > 0.99
    )


def test_ours_asks_no_point_that_no_skipping_leaves_out(avatar, learnt, generator):
    replay, backend = learnt.trainer.replay, avatar.field.backend
    rays = replay.draw(300, generator).rays
    everything = PosedSampler(
        backend, NothingKnown(), CellWarp(avatar.field, avatar.occupancy), avatar.step_m
    ).samples(rays, replay.cells)
    how = Marching(avatar.step_m, torch.inf, 512)
    ours = backend.march(rays, replay.cells, avatar.occupancy.grid, how)
    assert (everything.count >= ours.count).all()
    assert int(everything.count.sum()) > 1.5 * int(ours.count.sum())
    for ray in range(0, 300, 10):
        mine, all_of_them = (
            s.points[int(s.first[ray]) : int(s.first[ray]) + int(s.count[ray])]
            for s in (ours, everything)
        )
        if len(mine):
            gap = torch.cdist(mine.double(), all_of_them.double()).amin(dim=1)
            assert float((gap < 1e-4).float().mean()) > 0.9


# --- learning ---------------------------------------------------------------------------------

SMALL = TrainConfig(
    rays=200, step_m=0.02, finest_m=0.03, table_size=1 << 12, levels=4, empty_points=64,
    occupancy_every=8, refine_poses=False, key_frames=4,
)  # fmt: skip
VARIANTS = {
    "union": {"skipping": "union"},
    "frame": {"skipping": "frame"},
    "none": {"skipping": "none", "empty_weight": 0.0},
    "broyden": {"roots": "broyden"},
    "union, broyden": {"skipping": "union", "roots": "broyden"},
    "global": {"empty_term": "global"},
    "no alpha": {"alpha_weight": 0.0},
    "no hard surface": {"hard_weight": 0.0},
}


def trainer_of(rig, clip, **choices):
    trainer = Trainer(rig, dataclasses.replace(SMALL, **choices), CPU)
    for observation in clip.observations[:8:2]:
        trainer.add(prepare(observation, rig))
    return trainer


@pytest.mark.parametrize("choices", VARIANTS.values(), ids=VARIANTS.keys())
def test_every_variant_learns(rig, clip, choices):
    trainer = trainer_of(rig, clip, **choices)
    color = []
    for _ in range(30):
        result = trainer.step(rate=1.0, hard_share=0.0)
        assert result.samples > 200
        color.append(float(result.loss.mean()))
    assert np.mean(color[-5:]) < 0.5 * np.mean(color[:5])


@pytest.mark.parametrize("choices", VARIANTS.values(), ids=VARIANTS.keys())
def test_every_variant_takes_the_same_first_step_in_plain_torch(rig, clip, choices, monkeypatch):
    """The reference path, on any device that torch knows."""
    samples, losses = [], []
    for backend in ("numba", "torch"):
        monkeypatch.setenv("IA_BACKEND", backend)
        result = trainer_of(rig, clip, rays=60, **choices).step(rate=1.0, hard_share=0.0)
        samples.append(result.samples)
        losses.append(result.loss)
    assert samples[0] == pytest.approx(samples[1], rel=0.03)
    assert float((losses[0] - losses[1]).abs().median()) < 1e-4


@pytest.mark.parametrize("skipping", ["union", "frame", "none"])
def test_poses_are_pulled_alike_wherever_samples_lie(rig, clip, learnt, skipping):
    """What rays ask of a pose; the samples that ours leaves out carry no light."""
    avatar = learnt.trainer.avatar
    replay = Replay(1, CPU)
    frame = prepare(clip.observations[3], rig)
    slot = replay.add(frame)
    config = dataclasses.replace(learnt.trainer.config, empty_weight=0.0)
    found = []
    for choice in ("canonical", skipping):
        chosen = dataclasses.replace(config, skipping=choice)
        poses = PoseTable(rig, 1, CPU)
        poses.put(slot, frame.pose)
        sampler = sampler_for(chosen, avatar)
        sampler.admit(0, replay.cells, poses.bones[0])
        sampler.update(0, replay.cells, torch.Generator().manual_seed(0))
        batch = replay.draw(2000, torch.Generator().manual_seed(1))
        gradients(
            avatar.field, sampler, replay.cells, batch, chosen,
            hard_share=0.0, poses=poses, generator=torch.Generator().manual_seed(2),
        )  # fmt: skip
        avatar.field.table_grad.zero_()
        found.append(torch.from_numpy(poses.gradients(slot).ravel()))
    assert float(torch.cosine_similarity(*found, dim=0)) > 0.97


def test_global_sparsity_is_asked_for_in_the_whole_box(rig, clip):
    trainer = trainer_of(rig, clip, empty_term="global")
    points = trainer.sampler.empty_points(4000, torch.Generator().manual_seed(2))
    low, high = torch.from_numpy(rig.box_low), torch.from_numpy(rig.box_high)
    assert (points >= low).all()
    assert (points <= high).all()
    torch.testing.assert_close(points.mean(dim=0), (low + high) / 2, atol=0.05, rtol=0)
    # uniform on each axis: its spread is that of a uniform distribution
    torch.testing.assert_close(points.std(dim=0), (high - low) / 12**0.5, atol=0.02, rtol=0)


def test_global_sparsity_pulls_as_the_opacity_of_its_points_does(rig, clip):
    """Its gradient for the network's last bias, against central differences in double."""
    trainer = trainer_of(rig, clip, empty_term="global")
    for _ in range(10):
        trainer.step(rate=1.0, hard_share=0.0)
    field, config = trainer.avatar.field, trainer.config
    batch = trainer.replay.draw(config.rays, torch.Generator().manual_seed(1))
    pulls = []
    for weight in (1e-12, config.empty_weight):  # not 0: the points must be drawn all the same
        field.table_grad.zero_()
        gradients(
            field, trainer.sampler, trainer.replay.cells, batch,
            dataclasses.replace(config, empty_weight=weight),
            hard_share=0.0, generator=torch.Generator().manual_seed(2),
        )  # fmt: skip
        pulls.append(float(field.layers[3].grad[3]))
    points = trainer.sampler.empty_points(config.empty_points, torch.Generator().manual_seed(2))
    raw = field.raw_at(points)[:, 3].double()

    def mean_opacity(shift):
        return float((1.0 - torch.exp(-torch.exp(raw + shift) * 0.01)).mean())

    measured = (mean_opacity(1e-4) - mean_opacity(-1e-4)) / 2e-4
    assert pulls[1] - pulls[0] == pytest.approx(config.empty_weight * measured, rel=1e-3)

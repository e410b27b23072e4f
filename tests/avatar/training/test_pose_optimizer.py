"""Pose refinement: kernels, the implicit gradient, cells that follow, and poses that come back."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from avatar.config import COARSEST_M, TrainConfig
from avatar.correspondence_grid import CorrespondenceGrid
from avatar.evaluation.held_out import HeldOutFrame, score_frame
from avatar.kernels import numba_hash_grid, numba_pose, operations
from avatar.kernels.operands import FEATURES_PER_LEVEL, CorrespondenceTables, HashLevels, RaySamples
from avatar.render import correspondence_tables
from avatar.training import checkpoint
from avatar.training.frame_stream import prepare_stream
from avatar.training.held_out_pose_fitting import fit_test_poses
from avatar.training.pose_correction import MIN_RAY_LOSS, SIGMA_OF_ROW
from avatar.training.pose_optimizer import (
    FIRST_CORRECTION_STEPS,
    FREEZE_AFTER_STEPS,
    MIN_ESTIMATES_BEFORE_FREEZE,
    MIN_POSE_GRADIENT_CELL_M,
    PoseOptimizer,
)
from avatar.training.trainer import Trainer, cosine_decay
from baselines import torch_correspondence, torch_reference
from preprocess.body.body_pose import BodyPose
from preprocess.body.kinematics import descendant_matrix, joint_transforms, rotation_matrices
from tests.avatar_fixtures import pose_gradient


def pose_of(rotations, root=(0.1, 0.7, -0.2), place=(0.2, 0.1, -0.3)) -> BodyPose:
    root, place, rotations = np.array(root), np.array(place), np.asarray(rotations)
    return BodyPose(root_rotation=root, root_translation=place, joint_rotations=rotations)


@pytest.fixture
def table(rig, bent_pose) -> PoseOptimizer:
    table = PoseOptimizer(rig, 2)
    table.set_pose(0, pose_of(np.zeros((23, 3))))
    table.set_pose(1, pose_of(bent_pose))
    return table


def samples_near_the_skin(rig, count, generator):
    """Canonical samples of one ray of slot 1, each warped with a root of its own."""
    chosen = torch.randint(len(rig.seeds), (count,), generator=generator)
    points = torch.from_numpy(rig.seeds)[chosen]
    points = points + torch.randn(count, 3, generator=generator) * 0.01
    counts = torch.tensor([count], dtype=torch.int32)
    rows = torch.arange(count, dtype=torch.int32)
    return RaySamples(points, torch.zeros(1, dtype=torch.int64), counts, rows)


def cells_of(table, points):
    """Warp cells of slot 1: the inverse Jacobians of skinning at the points, by autograd."""
    leaf = points.clone().requires_grad_()
    posed = torch_correspondence.skin_points(leaf, *table.skinning, table.bones[1])
    rows = [torch.autograd.grad(posed[:, k].sum(), leaf, retain_graph=True)[0] for k in range(3)]
    roots = torch.zeros(2, len(points), 12)
    roots[1, :, 3:] = torch.linalg.inv(torch.stack(rows, dim=1)).flatten(1)
    ends = torch.zeros(2, 3)
    return CorrespondenceTables(torch.zeros(2, 1), roots, ends, ends, 0.03)


def wrenches_of(samples, pull, slots, cells, skin, bones):
    """Wrenches by the compiled kernel."""
    out = np.empty((len(slots), 24, 6), dtype=np.float32)
    numba_pose.write_wrenches(
        0, len(slots), samples.points.numpy(), pull.numpy(), samples.root_rows.numpy(),
        samples.offsets.numpy(), samples.counts.numpy(), slots.numpy(), cells.roots.numpy(),
        *operations._skinning_arrays(skin), bones.numpy(), out,
    )  # fmt: skip
    return torch.from_numpy(out)


def test_the_features_gradient_for_the_points_is_that_of_autograd(levels, generator):
    table = torch.randn(levels.entries, FEATURES_PER_LEVEL, generator=generator)
    extent = torch.from_numpy((levels.vertex_counts[0] - 1) / levels.cells_per_m[0]).float()
    points = torch.from_numpy(levels.low) + torch.rand(500, 3, generator=generator) * extent
    slope = torch.randn(500, levels.feature_width, generator=generator)
    leaf = points.clone().requires_grad_()
    features = torch_reference.encode(leaf, table, levels)
    (expected,) = torch.autograd.grad(features, leaf, slope)
    rows = torch.randperm(500, generator=generator)[:300].sort().values
    found = torch.zeros_like(points)
    numba_hash_grid.encode_points_backward(
        points.numpy(), rows.numpy(), levels.low, levels.cells_per_m, levels.vertex_counts,
        levels.is_dense, levels.offsets, table.numpy(), slope[rows].numpy(), np.float32(3.0),
        found.numpy(),
    )  # fmt: skip
    torch.testing.assert_close(found[rows], 3.0 * expected[rows], atol=3e-2, rtol=1e-4)
    assert int((found != 0.0).any(dim=1).sum()) == len(rows)


def test_compiled_wrenches_agree_with_their_meaning(rig, table, generator):
    samples = samples_near_the_skin(rig, 400, generator)
    pull, cells = torch.randn(400, 3, generator=generator), cells_of(table, samples.points)
    samples = samples._replace(
        offsets=torch.tensor([0, 150, 150]), counts=torch.tensor([150, 0, 250], dtype=torch.int32)
    )
    slots = torch.ones(3, dtype=torch.int32)
    operands = samples, pull, slots, cells, table.skinning, table.bones
    results = wrenches_of(*operands), torch_correspondence.bone_wrenches(*operands)
    assert float(results[0][1].abs().max()) == 0.0
    torch.testing.assert_close(*results, atol=2e-2, rtol=1e-3)


def test_cells_that_follow_a_pose_are_those_that_would_have_been_solved(rig, table, bent_pose):
    cells = CorrespondenceGrid.solve(rig, bent_pose)
    turned = Rotation.from_rotvec(bent_pose) * Rotation.from_rotvec(np.full((23, 3), 0.006))
    moved = rig.body_from_canonical(turned.as_rotvec())[:, :3].reshape(24, 12)
    tables, bones = correspondence_tables(cells), torch.from_numpy(moved.astype(np.float32))
    before = residual(rig, table, cells, tables.roots[0], bones)
    for _ in range(2):
        operations.update_roots(tables, [0], table.skinning, bones[None])
    after = residual(rig, table, cells, tables.roots[0], bones)
    assert np.median(before) > 3e-3
    assert np.quantile(after, 0.95) < 5e-4


def residual(rig, table, cells, roots, bones):
    """How far each root, skinned, is from its cell's centre."""
    place = np.argwhere(cells.packed_cells > 0)
    rows = cells.packed_cells[tuple(place.T)] >> 3
    posed = torch_correspondence.skin_points(roots[rows, :3], *table.skinning, bones).numpy()
    return np.linalg.norm(posed - (cells.low + (place + 0.5) * cells.cell_m), axis=1)


def test_the_poses_gradient_is_what_the_roots_do_when_the_pose_moves(rig, table, generator):
    """Against differences: move one number of the correction, find the roots again."""
    samples = samples_near_the_skin(rig, 300, generator)
    pull, cells = torch.randn(300, 3, generator=generator), cells_of(table, samples.points)
    slots = torch.ones(1, dtype=torch.int32)
    wrenches = wrenches_of(samples, pull, slots, cells, table.skinning, table.bones)
    table.accumulate(slots, wrenches, torch.ones(1))
    gradient = pose_gradient(table, 1)
    skin = torch_correspondence.skin_points
    given = skin(samples.points, *table.skinning, table.bones[1]).double().numpy()

    def pulled(joint: int, axis: int, size: float) -> float:
        table.corrections[1, joint, axis] = size
        table._update_bones(1)
        root = table.root_correction(1)
        target = root.pivot + (given - root.pivot - root.shift) @ root.rotation
        x = samples.points.clone()
        for _ in range(8):
            off = torch.from_numpy(target).float() - skin(x, *table.skinning, table.bones[1])
            x = x + (cells.roots[1, :, 3:].unflatten(1, (3, 3)) @ off[..., None])[..., 0]
        table.corrections[1, joint, axis] = 0.0
        table._update_bones(1)
        return float((x.double() * pull.double()).sum())

    for joint in (0, 1, 4, 9, 16, 18, 24):
        for axis in range(3):
            measured = (pulled(joint, axis, 2e-3) - pulled(joint, axis, -2e-3)) / 4e-3
            scale = float(np.abs(gradient[joint]).max()) + 0.1
            assert gradient[joint, axis] == pytest.approx(measured, abs=0.08 * scale), joint


def test_sums_over_rays_are_those_of_their_own_gradients(rig, table, generator):
    """By a matrix of what each number of the correction does to each bone's wrench."""
    joints = joint_transforms(rig.rest_joints, rig.parents, turns_of(table.pose(1)))
    places = (joints[:, :3, :3] @ rig.rest_joints[:, :, None])[..., 0] + joints[:, :3, 3]
    across, turned = np.cross(np.eye(3), places[:, None]), joints[:, :3, :3].swapaxes(1, 2)
    felt = np.zeros((25, 3, 24, 6))
    carried = np.concatenate([turned @ across, -turned], axis=2)
    felt[:24] = descendant_matrix(rig.parents)[:, None, :, None] * carried[:, :, None]
    felt[24, :, :, :3] = -np.eye(3)[:, None]
    wrenches, loss = torch.randn(40, 24, 6, generator=generator), torch.rand(40)
    table.accumulate(torch.ones(40, dtype=torch.int32), wrenches, loss)
    scaled = np.einsum("jabq,rbq->rja", felt, wrenches.numpy()) * SIGMA_OF_ROW[:, None]
    scaled = scaled.reshape(40, 75)
    curved = scaled / (2.0 * (loss.numpy() + MIN_RAY_LOSS))[:, None]
    found = table._rays.equations(1)
    assert found.moments is not None
    expected = scaled.sum(axis=0), curved.T @ scaled, scaled.T @ scaled
    sums = found.gradient, found.curvature, found.moments
    for ours, theirs in zip(sums, expected, strict=True):
        np.testing.assert_allclose(ours[..., :75], theirs, 1e-3, 1e-4 * np.abs(theirs).max())
        assert not ours[..., 75:].any()
    mean_ray = np.square(scaled).sum() / (curved * scaled).sum()
    assert found.ray_stiffness == pytest.approx(mean_ray, rel=1e-3)


def turns_of(pose: BodyPose):
    """Joint rotations in the body frame, where the root rests."""
    return rotation_matrices(np.concatenate([np.zeros((1, 3)), pose.joint_rotations]))


def test_bones_follow_the_corrected_pose(rig, bent_pose, rng):
    table = PoseOptimizer(rig, 1)
    table.set_pose(0, pose_of(bent_pose), correction=rng.normal(size=(25, 3)) * 0.3)
    bones = rig.body_from_canonical(table.pose(0).joint_rotations)[:, :3].reshape(24, 12)
    np.testing.assert_allclose(table.bones[0].numpy(), bones, atol=1e-6)
    root = rotation_matrices(table.corrections[0, 0])
    np.testing.assert_allclose(table.root_correction(0).rotation, root, atol=1e-12)


@pytest.fixture(scope="module")
def jittered(clip):
    """The clip with poses as a poor tracker gives them, but for every sixth frame."""
    rng = np.random.default_rng(0)

    def shaken(pose: BodyPose) -> BodyPose:
        root, place, joints = pose.root_rotation, pose.root_translation, pose.joint_rotations
        return BodyPose(
            root_rotation=root + 0.03 * rng.normal(size=3),
            root_translation=place + 0.02 * rng.normal(size=3),
            joint_rotations=joints + 0.05 * rng.normal(size=(23, 3)),
        )

    return [
        dataclasses.replace(o, pose=o.pose if o.frame.index % 6 == 5 else shaken(o.pose))
        for o in clip.observations
    ]


@pytest.mark.slow
def test_refining_poses_makes_up_for_a_trackers_jitter(rig, clip, jittered):
    """Scored in true poses: the canonical body itself must have become sharper."""
    config = TrainConfig(rays=512, sample_step_m=0.015, finest_m=0.03, levels=6, table_size=1 << 14)
    frames = list(prepare_stream(iter(jittered), rig, stride=6, total=None))
    held = [frame for frame in frames if isinstance(frame, HeldOutFrame)]
    reached = {}
    for refine_poses in (False, True):
        trainer = Trainer(rig, dataclasses.replace(config, refine_poses=refine_poses))
        for frame in frames:
            if not isinstance(frame, HeldOutFrame):
                trainer.add_frame(frame)
        for step in range(600):
            trainer.step(rate=cosine_decay(step / 600), hard_surface_share=1.0)
        scores = [score_frame(trainer.avatar, frame) for frame in held]
        reached[refine_poses] = np.mean([s.psnr_mask for s in scores])
    assert reached[True] > reached[False] + 1.5  # measured: 14.5 and 16.5 dB


def test_fitted_poses_score_better_where_the_given_ones_are_off_and_nowhere_worse(learnt, clip):
    pose = clip.observations[11].pose
    off = dataclasses.replace(pose, root_translation=pose.root_translation + np.array([0.03, 0, 0]))
    observation = dataclasses.replace(clip.observations[11], pose=off)
    cells = CorrespondenceGrid.solve(learnt.trainer.avatar.rig, off.joint_rotations)
    held = [HeldOutFrame(observation=seen) for seen in clip.observations[10:12]]
    held = [HeldOutFrame(observation=observation, correspondences=cells), *held]
    table = learnt.trainer.avatar.field.table.detach().clone()
    given, fitted = (
        [score_frame(learnt.trainer.avatar, frame) for frame in frames]
        for frames in (held, fit_test_poses(learnt.trainer, held))
    )
    assert fitted[0].psnr_mask > given[0].psnr_mask + 2.0
    assert all(after.psnr >= before.psnr for before, after in zip(given, fitted, strict=True))
    assert torch.equal(table, learnt.trainer.avatar.field.table)


@pytest.mark.parametrize("footprint_m", [0.002, 0.0035, 0.005, 0.007, 0.01])
@pytest.mark.parametrize("uncertainty", [0.0, 0.9, 1.0])
def test_cells_that_tell_of_poses_are_small_enough_whatever_the_detail(footprint_m, uncertainty):
    """Without levels below 37 mm poses drift in long trainings: 2 dB in new poses."""
    config = TrainConfig.for_budget(footprint_m=footprint_m, pose_uncertainty=uncertainty)
    levels = HashLevels.spanning(
        np.zeros(3, np.float32), np.ones(3, np.float32), coarsest_m=COARSEST_M,
        finest_m=config.finest_m, levels=config.levels, table_size=config.table_size,
    )  # fmt: skip
    finest = levels.count_from(MIN_POSE_GRADIENT_CELL_M) - 1
    assert 1.0 / levels.cells_per_m[finest] < 0.025


def test_fine_levels_pull_held_out_poses_in_the_second_half_alone(learnt, clip, monkeypatch):
    asked = list[float]()
    count = lambda levels, cell_m: (asked.append(cell_m), 1)[1]  # noqa: E731
    monkeypatch.setattr(HashLevels, "count_from", count)
    list(fit_test_poses(learnt.trainer, [HeldOutFrame(observation=clip.observations[11])]))
    assert asked == 6 * [MIN_POSE_GRADIENT_CELL_M] + 6 * [0.0]


def test_a_pose_that_was_refined_for_long_enough_stays(rig, bent_pose, generator):
    """Its rays pull no more; those of a frame that came later do."""
    table, pose = PoseOptimizer(rig, 2), pose_of(bent_pose)
    table.set_pose(0, pose, step=0)
    table.set_pose(1, pose, step=1000)
    slots = torch.arange(2, dtype=torch.int32).repeat_interleave(300)
    wrenches, loss = torch.randn(600, 24, 6, generator=generator), torch.full((600,), 0.1)

    def corrected(step):
        if table.freeze_converged(step):
            table.accumulate(slots, wrenches + 3.0, loss)
        return {table.correct_next(rate=1.0) for _ in range(2)} - {None}

    assert corrected(FREEZE_AFTER_STEPS - 1) == {0, 1}
    assert corrected(FREEZE_AFTER_STEPS) == {1}
    assert corrected(FREEZE_AFTER_STEPS + 1000) == set()


def test_a_frame_that_has_just_come_is_not_corrected_yet(rig, bent_pose, generator):
    """The field does not know yet what is seen from there, and all of its rays pull one way."""
    table = PoseOptimizer(rig, 2)
    table.set_pose(0, pose_of(bent_pose), step=500)
    wrenches, loss = torch.randn(300, 24, 6, generator=generator) + 3.0, torch.full((300,), 0.1)

    def corrected(step):
        open_now = table.freeze_converged(step)
        table.accumulate(torch.zeros(300, dtype=torch.int32), wrenches, loss)
        slot = table.correct_next(rate=1.0)
        assert open_now == (slot is not None)
        return slot

    assert corrected(500 + FIRST_CORRECTION_STEPS - 1) is None
    assert corrected(500 + FIRST_CORRECTION_STEPS) == 0


def test_a_pose_whose_rays_do_not_agree_is_exact_and_stays(rig, bent_pose, generator):
    """Chance is not believed again later; the frame whose rays all pull one way stays open."""
    table, pose = PoseOptimizer(rig, 2), pose_of(bent_pose)
    table.set_pose(0, pose)
    table.set_pose(1, pose)
    loss, later = torch.full((300,), 0.1), 300

    def pulled(step, slot, bias):
        table.freeze_converged(step)
        wrenches = torch.randn(300, 24, 6, generator=generator) + bias
        table.accumulate(torch.full((300,), slot, dtype=torch.int32), wrenches, loss)
        return table.correct_next(rate=1.0) is not None

    for step in range(60, 120):  # too early to judge; so long it takes until all together agree
        pulled(step, 0, 0.0)
    for step in range(later, later + MIN_ESTIMATES_BEFORE_FREEZE):
        pulled(step, 0, 0.0)
    assert not pulled(later + MIN_ESTIMATES_BEFORE_FREEZE, 0, 3.0)
    assert any(pulled(later + MIN_ESTIMATES_BEFORE_FREEZE + k, 1, 3.0) for k in range(5))


def test_estimated_poses_follow_their_rays_even_where_these_hardly_agree(rig, bent_pose, generator):
    """No gate, no damping, and the mean of all corrections stays: poses are known to be wrong."""
    loss = torch.full((300,), 0.1)
    tables = [PoseOptimizer(rig, 1, poses_may_be_exact=exact) for exact in (True, False)]
    for table in tables:
        table.set_pose(0, pose_of(bent_pose))
        for step in range(FREEZE_AFTER_STEPS - 20, FREEZE_AFTER_STEPS):
            table.freeze_converged(step)
            wrenches = torch.randn(300, 24, 6, generator=generator)
            table.accumulate(torch.zeros(300, dtype=torch.int32), wrenches, loss)
            table.correct_next(rate=1.0)
    assert not tables[0].corrections.any()
    assert np.abs(tables[1].corrections[0]).max() > 1e-3
    assert not tables[0].freeze_converged(FREEZE_AFTER_STEPS)
    assert tables[1].freeze_converged(FREEZE_AFTER_STEPS)
    assert tables[1].correction_interval(1.0) == 1
    assert tables[1].correction_interval(0.1) == 4


def test_a_held_out_pose_follows_more_rays_and_its_given_pose_less(rig, bent_pose, generator):
    wrenches, loss = torch.randn(1000, 24, 6, generator=generator), torch.full((1000,), 0.1)

    def correct(rays, precision):
        table = PoseOptimizer(
            rig, 1, poses_may_be_exact=False, rays_per_frame=1000, prior_precision=precision
        )
        table.set_pose(0, pose_of(bent_pose))
        table.accumulate(torch.zeros(rays, dtype=torch.int32), wrenches[:rays], loss[:rays])
        table.correct_next(rate=1.0)
        return np.linalg.norm(table.corrections[0])

    assert correct(400, 1.0) == 0.0  # it waits for more of them
    assert correct(600, 1.0) != correct(1000, 1.0)
    assert correct(1000, 0.01) > correct(1000, 1.0) > 0.0


def test_an_estimated_pose_remembers_its_rays_until_it_is_replaced(rig, bent_pose, generator):
    wrenches, loss = torch.randn(2, 300, 24, 6, generator=generator) + 3.0, torch.full((300,), 0.1)

    def second_correction(*, exact: bool, replaced: bool):
        table = PoseOptimizer(rig, 1, poses_may_be_exact=exact)
        for row in range(2):
            if row == 0 or replaced:
                table.set_pose(0, pose_of(bent_pose))
            table.corrections[0] = 0.0
            table._update_bones(0)
            table.accumulate(torch.zeros(300, dtype=torch.int32), wrenches[row], loss)
            table.correct_next(rate=1.0)
        return table.corrections[0]

    kept, replaced = (second_correction(exact=False, replaced=r) for r in (False, True))
    assert np.abs(kept - replaced).max() > 1e-4
    kept, replaced = (second_correction(exact=True, replaced=r) for r in (False, True))
    np.testing.assert_allclose(kept, replaced, atol=1e-6)


def test_a_correction_outlives_a_checkpoint(rig, clip, tmp_path):
    trainer = Trainer(rig, TrainConfig(table_size=1 << 12, levels=3, finest_m=0.05))
    frame = next(prepare_stream(iter(clip.observations), rig, stride=0, total=None))
    correction = np.full((25, 3), 0.02)
    trainer.pose_corrections[frame.index] = correction
    checkpoint.save(trainer, tmp_path)
    again, _ = checkpoint.load(tmp_path)
    again.add_frame(frame, is_restored=True)
    assert again.frames_seen == 0
    np.testing.assert_allclose(again.poses.corrections[0], correction)
    moved = again.poses.pose(0).root_translation - frame.pose.root_translation
    assert np.linalg.norm(moved) == pytest.approx(0.02 * np.sqrt(3))

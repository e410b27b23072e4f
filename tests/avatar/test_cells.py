"""Warp cells: canonical points come back from where skinning carried them."""

import numpy as np
import torch

from avatar.cells import WarpCells
from avatar.kernels import skin


def skinning(rig, rotations):
    """The skinning volume and a pose's bones, as the reference takes them."""
    nodes_per_m = (np.array(rig.weights.shape[:3]) - 1) / (rig.box_high - rig.box_low)
    bones = rig.body_from_canonical(rotations)[:, :3].reshape(24, 12)
    parts = rig.weights, rig.box_low, nodes_per_m, bones
    return tuple(torch.from_numpy(part).float() for part in parts)


def posed(rig, rotations, canonical):
    """Skins canonical points, with the reference."""
    return skin.skinned(torch.from_numpy(canonical), *skinning(rig, rotations))


def nearest_root_error(cells, targets, canonical):
    """How far the nearest of a cell's candidate roots is from where the point came from."""
    place = np.floor((targets - cells.low) / cells.cell_m).astype(int)
    packed = cells.index[tuple(place.T)]
    offset = targets - (cells.low + (place + 0.5) * cells.cell_m)
    error = np.full(len(targets), np.inf)
    for candidate in range(3):
        exists = (packed & 3) > candidate
        root = cells.roots[np.where(exists, (packed >> 2) + candidate, 0)]
        warp = root[:, 3:].reshape(-1, 3, 3)
        found = root[:, :3] + np.einsum("nab,nb->na", warp, offset)
        off = np.linalg.norm(found - canonical, axis=1)
        error = np.where(exists, np.minimum(error, off), error)
    return error


def around_the_skin(rig, rng, count=20000, spread=0.02):
    seeds = rig.seeds[rng.integers(0, len(rig.seeds), count)]
    return (seeds + rng.normal(size=(count, 3)) * spread).astype(np.float32)


def test_the_canonical_pose_warps_to_itself(rig, rng):
    canonical = around_the_skin(rig, rng)
    cells = WarpCells.of(rig, rig.canonical_rotations)
    error = nearest_root_error(cells, canonical, canonical)
    assert np.quantile(error, 0.999) < 1e-4


def test_points_come_back_from_a_bent_pose(rig, rng, bent_pose):
    canonical = around_the_skin(rig, rng)
    targets = posed(rig, bent_pose, canonical).numpy()
    error = nearest_root_error(WarpCells.of(rig, bent_pose), targets, canonical)
    assert np.median(error) < 1e-4
    assert np.quantile(error, 0.95) < 2e-3
    assert np.mean(error > 1e-2) < 2e-3


def test_roots_at_cell_centers_agree_with_broyden_per_sample(rig, bent_pose):
    cells = WarpCells.of(rig, bent_pose)
    place = np.argwhere((cells.index & 3) == 1)[::37]
    centers = torch.from_numpy((cells.low + (place + 0.5) * cells.cell_m).astype(np.float32))
    roots = torch.from_numpy(cells.roots[cells.index[tuple(place.T)] >> 2])
    found, rested = skin.find_roots(centers, roots[:, :3] + 0.004, *skinning(rig, bent_pose))
    assert rested.float().mean() > 0.95
    off = (found - roots[:, :3]).norm(dim=1)[rested]
    assert float(off.quantile(0.95)) < 1e-3


def test_the_inverse_jacobian_undoes_a_small_step(rig, bent_pose, rng):
    cells = WarpCells.of(rig, bent_pose)
    roots = cells.roots[1:][::29]
    step = rng.normal(size=(len(roots), 3)).astype(np.float32)
    step *= 1e-3 / np.linalg.norm(step, axis=1, keepdims=True)
    moved = posed(rig, bent_pose, roots[:, :3] + step) - posed(rig, bent_pose, roots[:, :3])
    back = np.einsum("nab,nb->na", roots[:, 3:].reshape(-1, 3, 3), moved.numpy())
    off = np.linalg.norm(back - step, axis=1)
    assert np.quantile(off, 0.9) < 1e-4


def test_no_cell_is_far_from_the_body(rig, bent_pose):
    cells = WarpCells.of(rig, bent_pose, band_m=0.05)
    place = (cells.roots[1:, :3] - rig.box_low) / (rig.box_high - rig.box_low)
    cell = (place * rig.distance.shape).astype(int)
    assert rig.distance[tuple(cell.T)].max() <= 0.05 + 0.5 * cells.cell_m


def test_wild_poses_are_solved_without_harm(rig, rng):
    """Far from anything a body does: roots may be lost, but all that is kept is finite."""
    for _ in range(20):
        cells = WarpCells.of(rig, rng.normal(size=(23, 3)) * 2.0)
        assert np.isfinite(cells.roots[1:]).all()
        place = (cells.roots[1:, :3] - rig.box_low) / (rig.box_high - rig.box_low)
        assert ((place >= 0.0) & (place <= 1.0)).all()


def test_only_nodes_near_the_skin_are_blended(rig):
    near, weights = rig.near_nodes
    assert len(near) < 0.4 * rig.weights[..., 0].size
    np.testing.assert_array_equal(weights, rig.weights.reshape(-1, 24)[near])

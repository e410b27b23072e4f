"""The rig and its volumes against the body they come from, and against bodies of simple shapes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import binary_fill_holes
from scipy.spatial import KDTree

from avatar.rig import (
    BLENDED_VERTICES,
    DISTANCE_CELL_M,
    HEAD_PART,
    MIN_VERTEX_DISTANCE_M,
    PART_OF_JOINT,
    SEARCHED_WITHIN_M,
    _outer_vertices,
    canonical_rotations,
    skinning_weight_volume,
    volume_shape,
)
from preprocess.body.body_pose import BodyPose
from preprocess.body.body_surface import vertex_normals
from preprocess.body.kinematics import PARENTS


@pytest.fixture(params=range(5))
def pose(request) -> BodyPose:
    """Any pose, however unnatural, with the root at rest."""
    rotations = np.random.default_rng(request.param).normal(size=(23, 3)) * 0.3 * request.param
    return replace(BodyPose.rest(), joint_rotations=rotations)


@pytest.fixture(scope="module")
def canonical(shaped) -> BodyPose:
    return replace(BodyPose.rest(), joint_rotations=canonical_rotations())


@pytest.fixture(scope="module")
def skin(shaped, canonical) -> np.ndarray:
    """Vertices in the canonical pose."""
    return shaped.with_pose(canonical).vertices()


def carried(transforms, points):
    return np.einsum("jab,jb->ja", transforms[:, :3, :3], points) + transforms[:, :3, 3]


def test_the_canonical_pose_is_an_a_pose(rig, shaped, canonical):
    joints = shaped.with_pose(canonical).joints()
    hands, hips = joints[[22, 23]], joints[[1, 2]]
    feet = joints[[10, 11]]
    assert (hands[:, 1] < joints[[16, 17], 1] - 0.3).all()  # lowered, …
    assert (np.abs(hands[:, 0]) > np.abs(hips[:, 0]) + 0.2).all()  # … and off the body
    assert (np.abs(feet[:, 0]) > np.abs(hips[:, 0])).all()
    np.testing.assert_array_equal(rig.canonical_rotations, canonical_rotations())


def test_the_canonical_pose_moves_nothing(rig):
    bones = rig.body_from_canonical(canonical_rotations())
    np.testing.assert_allclose(bones, np.tile(np.eye(4), (24, 1, 1)), atol=1e-12)


def test_bones_carry_each_canonical_joint_to_the_posed_one(rig, shaped, canonical, pose):
    bones = rig.body_from_canonical(pose.joint_rotations)
    found = carried(bones, shaped.with_pose(canonical).joints())
    np.testing.assert_allclose(found, shaped.with_pose(pose).joints(), atol=1e-9)
    squared = bones[:, :3, :3] @ bones[:, :3, :3].transpose(0, 2, 1)
    np.testing.assert_allclose(squared, np.tile(np.eye(3), (24, 1, 1)), atol=1e-12)


def test_skin_that_follows_one_bone_lands_where_the_body_has_it(rig, shaped, skin, pose):
    weights = shaped.body.weights
    stiff = np.flatnonzero(weights.max(axis=1) > 1.0 - 1e-9)
    bones = rig.body_from_canonical(pose.joint_rotations)[weights[stiff].argmax(axis=1)]
    expected = shaped.with_pose(pose).vertices()[stiff]
    assert len(stiff) > 100
    np.testing.assert_allclose(carried(bones, skin[stiff]), expected, atol=1e-7)


def test_the_box_is_the_canonical_body_and_its_margin(rig, skin):
    np.testing.assert_allclose(rig.box_low, skin.min(axis=0) - 0.17, atol=1e-6)
    np.testing.assert_allclose(rig.box_high, skin.max(axis=0) + 0.17, atol=1e-6)


def test_weights_are_shares_on_the_nodes_those_stored_and_beyond_the_box_its_borders(rig, rng):
    assert rig.weights.min() >= 0.0
    np.testing.assert_allclose(rig.weights.sum(axis=-1), 1.0, atol=1e-5)
    inside = rng.uniform(rig.box_low, rig.box_high, (1000, 3))
    np.testing.assert_allclose(rig.weights_at(inside).sum(axis=1), 1.0, atol=1e-5)
    shape = np.array(rig.weights.shape[:3])
    node = (rng.random((200, 3)) * shape).astype(int)
    points = rig.box_low + node / (shape - 1) * (rig.box_high - rig.box_low)
    np.testing.assert_allclose(rig.weights_at(points), rig.weights[tuple(node.T)], atol=1e-4)
    beyond = np.stack([rig.box_low - 1.0, rig.box_high + 1.0]).astype(np.float64)
    expected = np.stack([rig.weights[0, 0, 0], rig.weights[-1, -1, -1]])
    np.testing.assert_array_equal(rig.weights_at(beyond), expected)


def test_on_the_skin_the_weights_are_close_to_the_vertices(rig, shaped, skin):
    """Total variation: the share of the weight that sits on another joint than it should."""
    strays = 0.5 * np.abs(rig.weights_at(skin) - shaped.body.weights).sum(axis=1)
    assert strays.mean() < 0.05
    assert np.quantile(strays, 0.99) < 0.35


def test_far_from_creases_the_weights_are_those_of_the_nearest_vertex(rig, shaped, skin):
    """Where all skin within 10 cm follows one bone, so does the space around it."""
    weights = shaped.body.weights
    bone, stiff = weights.argmax(axis=1), weights.max(axis=1) > 0.999
    some = np.arange(0, len(skin), 10)
    around = KDTree(skin).query_ball_point(skin[some], 0.10)
    same = [stiff[near].all() and (bone[near] == bone[near[0]]).all() for near in around]
    place = some[np.array(same)]
    assert len(place) > 10
    np.testing.assert_allclose(rig.weights_at(skin[place]), weights[place], atol=2e-3)


def test_the_distance_is_that_to_the_nearest_vertex(rig, skin, rng):
    shape = np.array(rig.skin_distance.shape)
    cell = (rng.random((150, 3)) * shape).astype(int)
    centers = rig.box_low + (cell + 0.5) / shape * (rig.box_high - rig.box_low)
    expected = np.sqrt(((centers[:, None] - skin[None]) ** 2).sum(axis=-1)).min(axis=1)
    found = rig.skin_distance[tuple(cell.T)]
    near, within = expected < SEARCHED_WITHIN_M - DISTANCE_CELL_M, expected < 0.18
    assert near.any()
    assert not within.all()
    np.testing.assert_allclose(found[near], expected[near], atol=1e-5)
    np.testing.assert_allclose(found[within], expected[within], atol=DISTANCE_CELL_M)
    assert (found[expected > 0.2] == 1.0).all()


def test_a_head_is_solid(rig):
    """Behind its eyes, nostrils and lips there is no air."""
    head = rig.seeds[rig.seed_parts == HEAD_PART]
    low, high = (np.floor((end(head, axis=0) - rig.box_low) * rig.cells_per_m).astype(int)
                 for end in (np.min, np.max))  # fmt: skip
    inside = rig.inside_skin[low[0] : high[0] + 1, low[1] : high[1] + 1, low[2] : high[2] + 1]
    assert 0.3 < inside.mean() < 0.9
    for axis in range(3):
        for piece in np.moveaxis(inside, axis, 0):
            np.testing.assert_array_equal(binary_fill_holes(piece), piece)


def test_seeds_are_skin_and_leave_no_part_of_it_unseeded(rig, skin, shaped):
    on_outside = _outer_vertices(skin, vertex_normals(skin, shaped.body.faces), shaped.body)
    seeds = KDTree(rig.seeds)
    on_skin, _ = KDTree(skin).query(rig.seeds)
    outer = skin[on_outside]
    assert len(outer) > 0.85 * len(skin)
    reach, nearest = seeds.query(outer)
    assert on_skin.max() < 1e-6
    assert reach.max() < 0.02 * np.sqrt(3.0)  # a voxel's diagonal
    assert set(rig.seed_parts) == set(PART_OF_JOINT)
    assert len(np.unique(nearest)) == len(rig.seeds)


def test_body_parts_mirror():
    """Left and right joints belong to different parts unless both belong to the trunk."""
    pairs = [(1, 2), (4, 5), (7, 8), (10, 11), (13, 14), (16, 17), (18, 19), (20, 21), (22, 23)]
    for left, right in pairs:
        assert (PART_OF_JOINT[left] == PART_OF_JOINT[right]) == (PART_OF_JOINT[left] == 0)
        assert (PART_OF_JOINT[left] == PART_OF_JOINT[PARENTS[left]]) == (
            PART_OF_JOINT[right] == PART_OF_JOINT[PARENTS[right]]
        )


def winding_number(points, vertices, faces) -> np.ndarray:
    """How often a closed mesh winds about each point: its solid angle over 4π.

    Van Oosterom and Strackee 1983.
    """
    a, b, c = (vertices[faces[:, k]][None] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(side, axis=-1) for side in (a, b, c))
    volume = np.einsum("pfk,pfk->pf", a, np.cross(b, c))
    ab, bc, ca = ((x * y).sum(axis=-1) for x, y in ((a, b), (b, c), (c, a)))
    angle = 2.0 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb)
    return angle.sum(axis=1) / (4.0 * np.pi)


def test_what_is_inside_is_where_the_skin_winds_about_it(rig, skin, shaped, rng):
    shape = np.array(rig.skin_distance.shape)
    off_skin = np.argwhere((rig.skin_distance > 0.015) & (rig.skin_distance < 0.1))
    cell = off_skin[rng.integers(len(off_skin), size=60)]
    centers = rig.box_low + (cell + 0.5) / shape * (rig.box_high - rig.box_low)
    inside = winding_number(centers, skin, shaped.body.faces) > 0.5
    assert 0.05 < inside.mean() < 0.5
    assert (rig.inside_skin[tuple(cell.T)] == inside).mean() > 0.99


LOW, HIGH = np.array([-0.5, -0.3, -0.2]), np.array([0.5, 0.3, 0.2])
CELL_M = 0.05


def one_hot(joint, count=1):
    weights = np.zeros((count, 24))
    weights[:, joint] = 1.0
    return weights


def volume(vertices, weights, reach_m=10.0):
    return skinning_weight_volume(vertices, weights, LOW, HIGH, CELL_M, reach_m)


def two_blobs():
    """Thirty vertices of joint 4 at -x, thirty of joint 7 at the mirrored places."""
    left = np.random.default_rng(0).normal(size=(BLENDED_VERTICES, 3)) * 0.01 + [-0.2, 0.0, 0.0]
    right = left * [-1.0, 1.0, 1.0]
    return np.concatenate([left, right]), np.concatenate(
        [one_hot(4, BLENDED_VERTICES), one_hot(7, BLENDED_VERTICES)]
    )


@given(st.floats(0.01, 0.2))
def test_volumes_have_cells_of_about_the_size_asked_for(cell_m):
    shape = np.array(volume_shape(LOW, HIGH, cell_m))
    size = (HIGH - LOW) / shape
    assert (size <= cell_m * (1 + 1e-9)).all()
    assert ((HIGH - LOW) / (shape - 1 + 1e-12) >= cell_m * (1 - 1e-9)).all()


def test_out_of_reach_everything_hangs_on_the_root():
    vertices = np.random.default_rng(1).normal(size=(40, 3)) * 0.01
    weights = volume(vertices, one_hot(5, 40), reach_m=0.22)
    assert (weights[..., 0] + weights[..., 5]) == pytest.approx(np.ones(weights.shape[:3]))
    assert weights[0, 0, 0, 0] == 1.0
    assert weights[10, 6, 4, 5] == pytest.approx(1.0, abs=1e-6)


def test_a_mirrored_body_has_mirrored_weights():
    weights = volume(*two_blobs())
    np.testing.assert_allclose(weights[..., 4], weights[::-1, :, :, 7], atol=1e-5)
    np.testing.assert_allclose(weights[10, :, :, 4], 0.5, atol=1e-5)  # the plane between them


@pytest.mark.parametrize(("own_m", "others_m"), [(0.1, 0.3), (0.0, 0.02)])
def test_weights_fall_with_the_square_of_the_distance(own_m, others_m):
    """Of one vertex against all others, but a node on a vertex is not taken by it alone."""
    around = np.random.default_rng(2).normal(size=(BLENDED_VERTICES - 1, 3))
    around *= others_m / np.linalg.norm(around, axis=1, keepdims=True)
    vertices = np.concatenate([[[own_m, 0.0, 0.0]], around])
    weights = np.concatenate([one_hot(9), one_hot(2, BLENDED_VERTICES - 1)])
    end = np.full(3, 1e-5)
    share = skinning_weight_volume(vertices, weights, -end, end, 1e-5, 10.0)
    own = max(own_m, MIN_VERTEX_DISTANCE_M) ** -2
    others = (BLENDED_VERTICES - 1) * others_m**-2
    np.testing.assert_allclose(share[..., 9], own / (own + others), atol=1e-3)

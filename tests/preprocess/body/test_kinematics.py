"""Kinematics against scipy, closed forms and invariants."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from preprocess.body.kinematics import (
    PARENTS,
    body_from_rest,
    joint_transforms,
    rotation_matrices,
    world_from_body,
)

VECTORS = arrays(np.float64, 3, elements=st.floats(-4.0, 4.0, allow_subnormal=False))
TREE = np.array(PARENTS)


def rest_joints(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(24, 3))


def moved(transforms: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.einsum("jab,jb->ja", transforms[:, :3, :3], points) + transforms[:, :3, 3]


def descendants(joint: int) -> set[int]:
    inside = {joint}
    for child, parent in enumerate(PARENTS):
        if parent in inside:
            inside.add(child)
    return inside


def test_a_rotation_by_nothing_or_next_to_it_is_smooth():
    np.testing.assert_array_equal(rotation_matrices(np.zeros((4, 3)))[2], np.eye(3))
    tiny = rotation_matrices(np.array([1e-9, 0.0, 0.0]))
    np.testing.assert_allclose(tiny[2, 1], 1e-9, rtol=1e-12)


@given(st.integers(1, 23), VECTORS)
@settings(max_examples=25)
def test_bending_a_joint_moves_its_descendants_alone(joint, vector):
    bend = np.zeros((23, 3))
    bend[joint - 1] = vector
    transforms = body_from_rest(rest_joints(), TREE, bend)
    below = descendants(joint)
    for other in range(24):
        expected = np.eye(4)
        if other in below:
            pivot = rest_joints()[joint]
            expected[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
            expected[:3, 3] = pivot - expected[:3, :3] @ pivot
        np.testing.assert_allclose(transforms[other], expected, atol=1e-9)


@given(st.integers(0, 100))
@settings(max_examples=25)
def test_bones_keep_their_lengths(seed):
    rng = np.random.default_rng(seed)
    rest = rest_joints(seed)
    posed = moved(body_from_rest(rest, TREE, rng.normal(size=(23, 3))), rest)
    lengths = np.linalg.norm(posed[1:] - posed[TREE[1:]], axis=1)
    np.testing.assert_allclose(lengths, np.linalg.norm(rest[1:] - rest[TREE[1:]], axis=1))
    np.testing.assert_allclose(posed[0], rest[0], atol=1e-12)


@given(VECTORS, VECTORS, VECTORS)
@settings(max_examples=25)
def test_the_root_turns_about_the_pelvis(pelvis, rotation, translation):
    transform = world_from_body(pelvis, rotation, translation)
    np.testing.assert_allclose(
        transform @ np.append(pelvis, 1.0), np.append(pelvis + translation, 1.0), atol=1e-9
    )
    expected = Rotation.from_rotvec(rotation).as_matrix()
    np.testing.assert_allclose(transform[:3, :3], expected, atol=1e-9)


def test_the_world_and_the_body_make_the_whole_tree():
    rng = np.random.default_rng(2)
    rest, bends, turn = rest_joints(), rng.normal(size=(23, 3)), rng.normal(size=3)
    apart = world_from_body(rest[0], turn, np.zeros(3)) @ body_from_rest(rest, TREE, bends)
    rotations = rotation_matrices(np.concatenate([turn[None], bends]))
    np.testing.assert_allclose(apart, joint_transforms(rest, TREE, rotations), atol=1e-12)

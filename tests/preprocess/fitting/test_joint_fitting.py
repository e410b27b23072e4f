"""Our body is fitted to the joints of another one: proportions, poses, and how far it stays off."""

import numpy as np
import pytest

from preprocess.body.kinematics import PARENTS as TREE
from preprocess.body.kinematics import rotation_matrices
from preprocess.body.parametric_body import smpl_rest_joints
from preprocess.body.proportion_space import ProportionSpace
from preprocess.fitting.clip_poses import ClipPoses
from preprocess.fitting.joint_fitting import POINT_NAMES, fit_joints, rows_with_limbs
from tests.motions import angles_deg, posed_points

FRAMES = 8
PARENTS = np.array(TREE)


@pytest.fixture(scope="module")
def poses() -> ClipPoses:
    """A person who turns, bends knees and elbows, and walks."""
    rng = np.random.default_rng(2)
    share = np.linspace(0.0, 1.0, FRAMES)[:, None, None]
    vectors = np.tile(rng.normal(0.0, 0.12, (24, 3)), (FRAMES, 1, 1)) * (1.0 + share)
    vectors[:, 22:] = 0.0
    vectors[:, 0, 1] += 4.0 * share[:, 0, 0]
    vectors[:, [4, 5], 0] += 0.7
    vectors[:, 18, 1] -= 0.9
    vectors[:, 19, 1] += 0.9
    return ClipPoses(
        rotations=rotation_matrices(vectors),
        translations=share[:, 0] * [0.5, 0.1, 1.0] + [0.0, 1.0, 3.0],
    )


def times():
    return np.arange(FRAMES) / 30.0


def test_a_persons_joints_come_back(poses, shaped):
    space = ProportionSpace.around(shaped)
    person = space.shape(np.random.default_rng(1).normal(size=space.count))
    found = fit_joints(posed_points(poses, person.joints), times())
    assert found.distances_m.mean() < 0.005
    mine = found.poses.joints(space.shape(found.coefficients).joints, PARENTS)
    true = poses.joints(person.joints, PARENTS)
    turned = angles_deg(mine.turns, true.turns).mean(axis=0)
    assert turned[[0, 12, 15]].max() < 11.0  # pelvis, neck, head
    assert turned[:22].mean() < 12.0


def test_knuckles_and_eyes_tell_how_hands_and_head_are_turned(poses, shaped):
    rest = shaped.joints
    true = poses.joints(rest, PARENTS).turns
    errors = []
    for known in (len(POINT_NAMES), 24):
        places = posed_points(poses, rest)
        places[:, known:] = np.nan
        found = fit_joints(places, times())
        turns = found.poses.joints(rest, PARENTS).turns
        errors.append(angles_deg(turns, true).mean(axis=0)[[15, 20, 21]].mean())
    assert errors[0] < 0.6 * errors[1]


def test_known_rotations_are_kept(poses):
    rest = smpl_rest_joints()
    true = poses.joints(rest, PARENTS).turns
    places = posed_points(poses, rest)
    places[:, 24:] = np.nan
    found = fit_joints(places, times(), true)
    turns = found.poses.joints(rest, PARENTS).turns
    limbs = [4, 5, 18, 19, 20, 21]
    assert np.median(angles_deg(turns, true)[:, limbs]) < 12.0
    assert found.distances_m[:, limbs].mean() < 0.015


def test_rows_without_limbs_are_left_out(poses):
    places = posed_points(poses, smpl_rest_joints())
    places[[0, 3], 18] = np.nan
    np.testing.assert_array_equal(rows_with_limbs(places), [1, 2, 4, 5, 6, 7])
    with pytest.raises(ValueError, match="no frame has all"):
        rows_with_limbs(places[:1])

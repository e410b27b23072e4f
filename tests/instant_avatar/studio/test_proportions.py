"""Proportions: joints and skin move together."""

import numpy as np
import pytest

from instant_avatar.studio.outfit import SUBJECT_PROPORTIONS, BodyProportions
from preprocess.body.kinematics import PARENTS


def bone_m(joints, joint):
    return np.linalg.norm(joints[joint] - joints[PARENTS[joint]])


def test_without_changes_the_body_stays(shaped):
    same = BodyProportions()
    weights = shaped.body.weights
    np.testing.assert_allclose(same.move_joints(shaped.joints), shaped.joints, atol=1e-12)
    np.testing.assert_allclose(
        same.move_vertices(shaped.vertices, weights, shaped.joints), shaped.vertices, atol=1e-9
    )


def test_limbs_grow_by_their_factors_and_the_pelvis_stays(shaped):
    moved = BodyProportions(legs=1.1, arms=0.9).move_joints(shaped.joints)
    for joint, factor in ((4, 1.1), (7, 1.1), (18, 0.9), (21, 0.9), (15, 1.0)):
        assert bone_m(moved, joint) / bone_m(shaped.joints, joint) == pytest.approx(factor)
    np.testing.assert_allclose(moved[0], shaped.joints[0])


@pytest.mark.parametrize("subject", SUBJECT_PROPORTIONS)
def test_skin_stays_around_its_joints(shaped, subject):
    """The mean of a joint's ring of skin moves as the joint does."""
    own, weights = SUBJECT_PROPORTIONS[subject], shaped.body.weights
    moved = own.move_vertices(shaped.vertices, weights, shaped.joints)
    joints = own.move_joints(shaped.joints)
    for joint in (4, 5, 18, 19):
        ring = np.linalg.norm(shaped.vertices - shaped.joints[joint], axis=1) < 0.09
        before = shaped.vertices[ring].mean(axis=0) - shaped.joints[joint]
        after = moved[ring].mean(axis=0) - joints[joint]
        assert np.linalg.norm(after - before) < 0.01

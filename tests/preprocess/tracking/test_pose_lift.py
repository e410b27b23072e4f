"""Poses from the key points of a known motion."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from preprocess.body.body_pose import Motion
from preprocess.tracking.pose_lift import lift_keypoints


@pytest.fixture
def walker(turning_person) -> Motion:
    return turning_person(12)


def relative_joints(shaped, motion):
    joints = np.stack([shaped.with_pose(motion[row]).joints() for row in range(len(motion))])
    return joints - joints[:, :1]


def test_bent_limbs_and_the_roots_turn_come_back(walker, mean_body, keypoint_camera, track_motion):
    lifted = lift_keypoints(track_motion(walker), mean_body, keypoint_camera)
    off = relative_joints(mean_body, lifted) - relative_joints(mean_body, walker)
    assert np.linalg.norm(off, axis=2).mean() < 0.03
    turned = Rotation.from_rotvec(lifted.root_rotations).inv() * Rotation.from_rotvec(
        walker.root_rotations
    )
    assert np.degrees(turned.magnitude()).max() < 6.0
    assert np.abs(lifted.root_translations - walker.root_translations).max() < 0.15
    assert lifted.intrinsic[0, 0] == keypoint_camera.focal_px[0]
    assert lifted.keypoints is not None


def test_a_bent_elbow_tells_the_twist_of_the_upper_arm(
    walker, mean_body, keypoint_camera, track_motion
):
    """By hinges, not by the smallest swing: elbows and knees bend about their own axes alone."""
    lifted = lift_keypoints(track_motion(walker), mean_body, keypoint_camera)
    bends = lifted.joint_rotations[:, [17, 18, 3, 4]]
    assert (bends[:, 0, 1] < -0.3).all()
    assert (bends[:, 1, 1] > 0.3).all()
    assert (bends[:, 2:, 0] > 0.1).all()
    assert np.abs(bends[:, :2, 2]).max() < 0.25


def test_short_gaps_are_bridged_and_long_ones_stay(
    turning_person, mean_body, keypoint_camera, track_motion
):
    track = track_motion(turning_person(60))
    seen = ~np.isin(np.arange(60), [5, 6, 7, *range(20, 50)])
    rows = np.flatnonzero(seen)
    fields = ("frames", "image_px", "world_m", "visibility", "presence", "times_s")
    partial = replace(track, **{name: getattr(track, name)[rows] for name in fields})
    partial.presence[10] = 0.1
    lifted = lift_keypoints(partial, mean_body, keypoint_camera)
    assert lifted.frames.tolist() == [*range(20), *range(50, 60)]
    assert lifted.valid.all()

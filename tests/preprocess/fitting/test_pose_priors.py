"""What is known of poses before any picture."""

from dataclasses import replace

import numpy as np

from preprocess.fitting.clip_poses import POSE_SIGMA, ClipPoses, GivenPosePrior, HumanPosePrior
from preprocess.fitting.normal_equations import ChainEquations


def settle(poses: ClipPoses, iterations: int = 8) -> ClipPoses:
    """The poses that the prior alone leads to, held near where they are."""
    count = len(poses.translations)
    cameras = np.tile(np.eye(3), (count, 1, 1))
    prior = HumanPosePrior(cameras, np.arange(count) / 30.0)
    start = poses
    for _ in range(iterations):
        equations = ChainEquations.empty(count, 75, 1)
        prior.add_to(equations, poses)
        back = 0.05 * poses.steps_from(start, cameras) / POSE_SIGMA
        each = np.arange(75)
        equations.blocks[:, each, each] += 0.05
        equations.right[:] -= back
        equations.add_shared(np.ones(1), np.zeros(1))
        poses = poses.moved(equations.solve()[0] * POSE_SIGMA, cameras)
    return poses


def test_a_knee_that_is_twisted_bends_instead(turning_person):
    motion = turning_person(5)
    twisted = motion.joint_rotations.copy()
    twisted[:, 3] = 0.5, 0.4, 0.3
    knee = settle(ClipPoses.of(replace(motion, joint_rotations=twisted), range(5)))[2]
    assert np.abs(knee.joint_rotations[3, 1:]).max() < 0.15
    assert knee.joint_rotations[3, 0] > 0.2


def test_a_steady_turn_stays_and_jitter_goes(turning_person):
    motion, generator = turning_person(30), np.random.default_rng(0)
    steady = ClipPoses.of(motion, range(30))
    shaken = replace(
        motion, root_rotations=motion.root_rotations + 0.02 * generator.normal(size=(30, 3))
    )
    cameras = np.tile(np.eye(3), (30, 1, 1))
    kept = settle(steady).steps_from(steady, cameras)[5:-5, :3]
    calmed = settle(ClipPoses.of(shaken, range(30))).steps_from(steady, cameras)[5:-5, :3]
    before = ClipPoses.of(shaken, range(30)).steps_from(steady, cameras)[5:-5, :3]
    assert np.abs(kept).max() < 0.01
    assert np.diff(calmed, axis=0).std() < 0.35 * np.diff(before, axis=0).std()


def test_given_knees_bend_forwards_only_and_toes_are_straight(turning_person):
    motion, cameras = turning_person(5), np.tile(np.eye(3), (5, 1, 1))
    off = motion.joint_rotations.copy()
    off[:, 3] = 0.5, 0.4, 0.3  # a knee
    off[:, 15] = 0.2, -0.3, -1.2  # a shoulder
    off[:, 9] = 0.0, 0.2, 0.0  # toes
    given = ClipPoses.of(replace(motion, joint_rotations=off), range(5))
    prior, poses = GivenPosePrior(given, cameras, np.arange(5.0)), given
    for _ in range(8):
        equations = ChainEquations.empty(5, 75, 1)
        prior.add_to(equations, poses)
        equations.add_shared(np.ones(1), np.zeros(1))
        poses = poses.moved(equations.solve()[0] * POSE_SIGMA, cameras)
    joints = poses[2].joint_rotations
    assert np.abs(joints[3, 1:]).max() < 0.15
    assert joints[3, 0] > 0.4
    assert np.allclose(joints[15], off[2, 15], atol=1e-3)
    assert abs(joints[9, 1]) < 0.05

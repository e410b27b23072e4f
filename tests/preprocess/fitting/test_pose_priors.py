"""What is known of poses before any picture, and the equations of a step."""

from dataclasses import replace

import numpy as np

from preprocess.body.kinematics import PARENTS
from preprocess.fitting.clip_poses import (
    POSE_SIGMA,
    ClipPoses,
    GivenPosePrior,
    HumanPosePrior,
    rotation_vectors,
)
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


def beside_given(given: ClipPoses, hip_turn: float | None = None) -> ClipPoses:
    """Where the prior beside given poses leads, if something says how a left hip has turned."""
    count = len(given.translations)
    cameras, poses = np.tile(np.eye(3), (count, 1, 1)), given
    prior, by_hip = GivenPosePrior(given, cameras, np.arange(float(count))), np.eye(75)[3:6]
    for _ in range(8):
        equations = ChainEquations.empty(count, 75, 1)
        steps = poses.steps_from(given, cameras)
        for frame in range(count if hip_turn is not None else 0):
            off = (steps[frame, 3:6] - (hip_turn, 0.0, 0.0)) / POSE_SIGMA[3:6]
            equations.add(frame, by_hip, np.zeros((3, 1)), off, np.full(3, 1e6))
        by = prior.add_to(equations, poses)
        equations.add_shared(np.ones(1), np.zeros(1))
        poses = poses.moved((by @ equations.solve()[0][..., None])[..., 0], cameras)
    return poses


def test_given_knees_and_toes_nearly_as_usual_are_straightened(turning_person):
    motion = turning_person(5)
    off = motion.joint_rotations.copy()
    off[:, [3, 4], 1:] = 0.0
    off[:, 3, 1:] = 0.05, 0.05  # a knee
    off[:, 15] = 0.2, -0.3, -1.2  # a shoulder
    off[:, 9] = 0.0, 0.05, 0.0  # toes
    given = ClipPoses.of(replace(motion, joint_rotations=off), range(5))
    joints = beside_given(given)[2].joint_rotations
    assert np.abs(joints[3, 1:]).max() < 0.03
    assert np.allclose(joints[15], off[2, 15], atol=0.01)
    assert abs(joints[9, 1]) < 0.03


def test_given_knees_that_are_clearly_unusual_stay(turning_person):
    motion = turning_person(5)
    off = motion.joint_rotations.copy()
    off[:, 3] = 0.5, 0.4, 0.3
    given = ClipPoses.of(replace(motion, joint_rotations=off), range(5))
    assert np.allclose(beside_given(given)[2].joint_rotations[3], off[2, 3], atol=0.1)


def test_a_shin_points_where_it_did_when_the_thigh_turns(turning_person):
    given = ClipPoses.of(turning_person(5), range(5))
    rest = np.zeros((24, 3))
    turned = beside_given(given, hip_turn=0.15)
    before, after = (each.joints(rest, np.array(PARENTS)).turns for each in (given, turned))
    apart = np.linalg.norm(rotation_vectors(before.swapaxes(-1, -2) @ after), axis=-1)
    assert np.allclose(apart[:, 1], 0.15, atol=0.01)
    assert apart[:, 4].max() < 0.03


def test_the_chain_is_solved_as_the_whole_matrix_is():
    generator = np.random.default_rng(0)
    frames, own, shared = 5, 4, 3
    equations = ChainEquations.empty(frames, own, shared)
    total = frames * own + shared
    dense, right = np.zeros((total, total)), np.zeros(total)
    for frame in range(frames):
        jacobian, jacobian_shared = generator.standard_normal((2, 20, 4))
        jacobian_shared = jacobian_shared[:, :shared]
        residuals, weights = generator.standard_normal(20), generator.random(20)
        equations.add(frame, jacobian, jacobian_shared, residuals, weights)
        whole = np.zeros((20, total))
        whole[:, frame * own : (frame + 1) * own] = jacobian
        whole[:, frames * own :] = jacobian_shared
        dense += whole.T @ (weights[:, None] * whole)
        right -= whole.T @ (weights * residuals)
    state, state_shared = (
        generator.standard_normal((frames, own)),
        generator.standard_normal(shared),
    )
    links, precision = generator.random((frames - 1, own)), generator.random(shared)
    equations.add_chain(state, np.ones(state.shape[1]), links)
    equations.add_shared(precision, state_shared)
    flat = state.ravel()
    dense[range(frames * own), range(frames * own)] += 1.0
    right[: frames * own] -= flat
    for gap in range(frames - 1):
        for each in range(own):
            row = np.zeros(total)
            row[gap * own + each], row[(gap + 1) * own + each] = -1.0, 1.0
            dense += links[gap, each] * np.outer(row, row)
            right -= links[gap, each] * row * (state[gap + 1, each] - state[gap, each])
    corner = range(frames * own, total)
    dense[corner, corner] += precision
    right[frames * own :] -= precision * state_shared
    expected = np.linalg.solve(dense, right)
    found, found_shared = equations.solve()
    assert np.allclose(found.ravel(), expected[: frames * own])
    assert np.allclose(found_shared, expected[frames * own :])


def test_other_parameters_lead_to_the_same_step():
    generator = np.random.default_rng(0)
    by, found = generator.standard_normal((2, 3, 3)), []
    for changes in (False, True):
        equations = ChainEquations.empty(2, 3, 1)
        jacobian, residuals = np.arange(1.0, 13.0).reshape(4, 3) ** 0.5, np.arange(4.0)
        for frame in range(2):
            equations.add(frame, jacobian, np.ones((4, 1)), residuals + frame, np.ones(4))
        equations.blocks[:] += np.eye(3)
        equations.add_shared(np.ones(1), np.zeros(1))
        if changes:
            equations.change_parameters(by)
        moved, shared = equations.solve()
        moved = (by @ moved[..., None])[..., 0] if changes else moved
        found.append(np.append(moved.ravel(), shared))
    assert np.allclose(*found)


def test_what_is_held_does_not_move():
    equations = ChainEquations.empty(2, 3, 2)
    equations.add(0, np.eye(3), np.ones((3, 2)), np.ones(3), np.ones(3))
    equations.add_chain(np.zeros((2, 3)), np.ones(3), np.ones((1, 3)))
    equations.add_shared(np.ones(2), np.zeros(2))
    equations.hold(np.array([1e9, 0.0]), 0.0)
    moved, shared = equations.solve()
    assert abs(shared[0]) < 1e-6 < abs(shared[1])
    assert np.abs(moved[1]).max() > 1e-3  # neighbors are coupled

"""Poses in other units than radians and metres, and poses that only look as if they were."""

from dataclasses import replace

import numpy as np
import pytest

from capture.input_error import InputError
from preprocess.body.body_pose import Motion, RelativeFocalLength
from preprocess.poses.plausibility import (
    implausibility_reason,
    plausibility_warnings,
    require_plausible,
)
from tests.motions import make_motion, make_track

WRIST = 19
"""Row of the left wrist among the joints without the root."""
POSES = 30


@pytest.fixture
def walk() -> Motion:
    """A person who walks past at 1.2 m/s, 3 m away, with swinging arms and legs."""
    phase = np.linspace(0.0, 4.0 * np.pi, POSES)
    joints = np.zeros((POSES, 23, 3))
    joints[:, [0, 1, 15, 16], 0] = 0.5 * np.sin(phase)[:, None]
    joints[:, [15, 16], 2] = -1.0, 1.0
    places = np.zeros((POSES, 3))
    places[:, 0], places[:, 2] = 0.04 * np.arange(POSES), 3.0
    return make_motion(np.tile([np.pi, 0.0, 0.1], (POSES, 1)), places, joints, "smpl")


def spun(walk, turns_a_pose: float) -> Motion:
    """The walk with a root whose angle counts on."""
    roots = np.zeros((POSES, 3))
    roots[:, 1] = 2.0 * np.pi * turns_a_pose * np.arange(POSES)
    return replace(walk, root_rotations=roots)


def test_radians_and_metres_pass_without_a_word(walk):
    assert implausibility_reason(walk) is None
    assert list(plausibility_warnings(walk)) == []
    np.testing.assert_array_equal(require_plausible(walk, "walk.npz").valid, True)


@pytest.mark.parametrize("turns_a_pose", [0.02, 0.1, 0.4])
def test_a_spin_may_count_on_beyond_a_turn(walk, turns_a_pose):
    """Also one of 144° from pose to pose, as few photographs of a turning person show it."""
    spin = spun(walk, turns_a_pose)
    assert implausibility_reason(spin) is None
    assert list(plausibility_warnings(spin)) == []


@pytest.mark.parametrize("rows", [1, POSES])
def test_degrees_are_refused(walk, rows):
    degrees = replace(walk, joint_rotations=np.rad2deg(walk.joint_rotations))
    with pytest.raises(InputError, match=r"walk\.npz: A joint is bent by 3\d\d\d°.*degrees given"):
        require_plausible(degrees.select_rows(np.arange(rows)), "walk.npz")


def test_one_damaged_pose_is_left_out_and_named(walk):
    joints = walk.joint_rotations.copy()
    joints[4, 7] = 0.0, 25.0, 0.0
    damaged = replace(walk, joint_rotations=joints)
    kept = require_plausible(damaged, "walk.npz").valid
    np.testing.assert_array_equal(kept, np.arange(POSES) != 4)
    (sentence,) = plausibility_warnings(damaged)
    assert sentence.startswith("Left out: 1 of 30 poses, with a joint bent by more")


@pytest.mark.parametrize("unit", [1000.0, 100.0])
def test_places_in_other_units_are_refused_or_named(walk, unit):
    scaled = replace(walk, root_translations=unit * walk.root_translations)
    if unit == 1000.0:
        with pytest.raises(InputError, match="millimetres or centimetres given"):
            require_plausible(scaled, "walk.npz")
    else:
        (sentence,) = plausibility_warnings(scaled)
        assert "are they in metres?" in sentence


def test_depths_for_a_trackers_own_lens_are_not_judged(walk):
    """4D-Humans takes a focal length of 5000 px for a crop, and puts people far away."""
    far = replace(walk, root_translations=25.0 * walk.root_translations, space="camera")
    assert list(plausibility_warnings(far)) != []
    far = replace(far, assumed_focal=RelativeFocalLength(ratio=19.5))
    assert list(plausibility_warnings(far)) == []


def test_poses_that_are_all_lost_are_left_to_others(walk):
    lost = replace(walk, valid=np.zeros(POSES, dtype=bool))
    assert implausibility_reason(lost) is None
    assert list(plausibility_warnings(lost)) == []


def turning(count: int, step_rad: float) -> Motion:
    """A person who turns about the vertical axis."""
    roots = np.zeros((count, 3))
    roots[:, 1] = step_rad * np.arange(count)
    return make_motion(roots, model="smpl")


def take_front_for_back(motion: Motion, rows: list[int]) -> Motion:
    """Some poses mirrored in depth."""
    roots = motion.root_rotations.copy()
    roots[rows, 1] = np.pi - roots[rows, 1]
    return replace(motion, root_rotations=roots)


@pytest.mark.parametrize(
    ("step_rad", "rows"),
    [(0.03, [20, 21, 22]), (0.03, [5]), (0.03, [34, 35, 36]), (0.2, [1, 2]), (0.2, [4, 5, 6]),
     (0.2, [32, 33, 34])],
)  # fmt: skip
def test_front_taken_for_back_is_left_out_and_named(step_rad, rows):
    """Also near a side view, where the turn is 65 degrees, or has no jump at one end."""
    motion = take_front_for_back(turning(60, step_rad), rows)
    assert np.flatnonzero(~require_plausible(motion, "poses.npz").valid).tolist() == rows
    (sentence,) = plausibility_warnings(motion)
    assert f"{len(rows)} of 60 poses (the first is row {rows[0]})" in sentence
    assert "front was taken for back" in sentence


def test_turns_of_films_and_photographs_are_no_flips():
    """A fast spin, a cut to the other side, and photographs a quarter turn apart."""
    cut = turning(60, 0.03)
    cut.root_rotations[30:, 1] += np.pi
    for motion in (turning(60, 0.5), cut, turning(8, 0.5 * np.pi), turning(8, 2.0)):
        assert require_plausible(motion, "poses.npz").valid.all()


def test_a_wrist_that_flips_is_interpolated_and_named():
    """Half a turn of the left wrist for three of 60 poses; a wrist that waves fast stays."""
    motion = turning(60, 0.03)
    joints = motion.joint_rotations.copy()
    joints[:, WRIST, 0] = 0.02 * np.arange(60)
    joints[:, WRIST + 1, 2] = 0.6 * np.sin(np.arange(60))
    flipped = joints.copy()
    flipped[20:23, WRIST, 0] += 2.5
    motion = replace(motion, joint_rotations=flipped)
    kept = require_plausible(motion, "poses.npz")
    np.testing.assert_allclose(kept.joint_rotations, joints, atol=1e-6)
    assert kept.valid.all()
    (sentence,) = plausibility_warnings(motion)
    assert "3 of 60 poses (the first is row 20)" in sentence
    assert "the left wrist" in sentence


def test_rows_without_a_pose_and_limbs_of_flipped_ones_are_no_flipped_joints():
    """Files mark lost poses by NaN; who is turned round is left out with the arms."""
    motion = take_front_for_back(turning(60, 0.03), [20, 21, 22])
    motion.joint_rotations[20:23, WRIST, 0] += 2.5
    motion.joint_rotations[40:43] = np.nan
    motion.valid[40:43] = False
    (sentence,) = plausibility_warnings(motion)
    assert "front was taken for back" in sentence


def test_poses_that_were_tracked_here_keep_their_fast_joints():
    """They were fitted to the film: a runner's leg swings faster than other trackers are right."""
    motion = turning(60, 0.03)
    motion.joint_rotations[20:23, WRIST, 0] += 2.5
    track = make_track(np.arange(60), (64, 64))
    motion = replace(motion, proportions=np.zeros(1), keypoints=track)
    kept = require_plausible(motion, "poses.npz").joint_rotations
    np.testing.assert_array_equal(kept, motion.joint_rotations)
    assert list(plausibility_warnings(motion)) == []


def test_poses_that_are_far_apart_stay_as_they_are():
    """Twelve poses of a dance: one differs from both its neighbors, which are alike."""
    angles = 0.5 * np.array([0, 1, 2, 0, 1, 2, 2, 5, 2, 1, 0, 1])
    motion = turning(12, 0.0)
    motion.root_rotations[:, 1] = angles
    motion.joint_rotations[:, WRIST, 0] = angles
    kept = require_plausible(motion, "poses.npz")
    assert kept.valid.all()
    np.testing.assert_array_equal(kept.joint_rotations, motion.joint_rotations)

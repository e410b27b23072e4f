"""Driving motions, and the camera that follows them from a viewpoint."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from instant_avatar.animation.driving_motion import (
    DISTANCE_HEIGHTS,
    FollowingCamera,
    ResampledMotion,
    canonical_pose_of,
    demo_motion,
)
from instant_avatar.animation.play_arguments import CLOSE_UP_ZOOM, Viewpoint
from preprocess.body.body_pose import BodyPose
from preprocess.body.kinematics import rotation_matrices
from tests.motions import make_motion


@pytest.fixture
def following(player):
    """A camera about the standing avatar, which faces the world's z."""

    def of(size=96, **wishes):
        return FollowingCamera.of(player, demo_motion(2), size, Viewpoint(**wishes))

    return of


def middle(following, pose):
    """Where the camera looks at, in the world."""
    camera, away = following.camera_for(pose), DISTANCE_HEIGHTS * following.height_m
    return camera.center_world + away * camera.camera_from_world[2, :3]


@pytest.mark.parametrize(
    ("wishes", "direction"),
    [
        ({}, (0, 0, 1)),
        ({"orbit_deg": 90.0}, (1, 0, 0)),
        ({"orbit_deg": 180.0}, (0, 0, -1)),
        ({"orbit_deg": -90.0}, (-1, 0, 0)),
        ({"elevation_deg": 90.0}, (0, 1, 0)),
        ({"elevation_deg": -30.0}, (0, -0.5, np.sqrt(0.75))),
        ({"orbit_deg": 90.0, "elevation_deg": 30.0}, (np.sqrt(0.75), 0.5, 0)),
    ],
)
def test_the_camera_stands_where_its_angles_say_and_looks_at_the_persons_middle(
    player, following, wishes, direction
):
    pose, camera = canonical_pose_of(player), following(**wishes)
    pelvis = player.manifest.rest_joints[0]
    at = pelvis + camera.center_above_pelvis_m * np.array([0.0, 1.0, 0.0])
    place = camera.camera_for(pose).center_world
    away = DISTANCE_HEIGHTS * camera.height_m
    np.testing.assert_allclose(place - at, away * np.array(direction), atol=1e-9)
    assert camera.camera_for(pose).project(at) == pytest.approx([48.0, 48.0])


def test_a_turntable_goes_round_once_in_its_time(player, following):
    pose = canonical_pose_of(player)
    for period, seconds, degrees in (
        (8.0, 0.0, 0.0), (8.0, 2.0, 90.0), (8.0, 5.0, 225.0), (8.0, 8.0, 0.0), (-8.0, 2.0, -90.0),
    ):  # fmt: skip
        np.testing.assert_allclose(
            following(turn_period_s=period).camera_for(pose, seconds).camera_from_world,
            following(orbit_deg=degrees).camera_for(pose).camera_from_world,
            atol=1e-9,
        )


def test_a_close_up_keeps_its_joint_in_the_middle(player, following, bent_arm):
    left = following(joint="left_hand")
    at, elbow = middle(left, bent_arm), middle(following(joint="left_elbow"), bent_arm)
    rest = player.manifest.rest_joints
    # the forearm points forward, out of the chest, by its own length
    assert at - elbow == pytest.approx(
        rotation_matrices(bent_arm.joint_rotations[17]) @ (rest[22] - rest[18]), abs=1e-9
    )
    whole, close = following().camera_for(bent_arm), left.camera_for(bent_arm)
    assert close.focal_px[0] == pytest.approx(CLOSE_UP_ZOOM * whole.focal_px[0])


@pytest.fixture
def bent_arm():
    """The T-pose with the left forearm forward."""
    joints = np.zeros((23, 3))
    joints[17, 1] = -np.pi / 2.0
    place = np.array([1.0, 2.0, 3.0])
    return replace(BodyPose.rest(), root_translation=place, joint_rotations=joints)


@pytest.mark.parametrize(
    ("size", "share"), [((160, 90), 0.8), ((90, 160), 0.675), ((256, 256), 0.8)]
)
def test_the_whole_person_takes_most_of_a_picture_of_every_shape(player, following, size, share):
    pose = canonical_pose_of(player)
    alpha = player.render(pose, following(size).camera_for(pose))[..., 3]
    assert alpha.shape == size[::-1]
    border = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
    assert not border.any()
    rows = np.flatnonzero((alpha > 127).any(axis=1))
    assert (rows[-1] + 1 - rows[0]) / size[1] == pytest.approx(share, abs=0.03)
    assert (rows[-1] + 1 + rows[0]) / size[1] == pytest.approx(1.0, abs=0.03)


def test_the_camera_does_not_depend_on_where_the_trackers_world_lies(player, rng):
    motion, pelvis = motion_of(30.0, 1, rng), player.manifest.rest_joints[0]
    turn, shift = rotation_matrices(rng.normal(size=3)), rng.normal(size=3)
    moved = replace(
        motion,
        root_rotations=(
            Rotation.from_matrix(turn) * Rotation.from_rotvec(motion.root_rotations)
        ).as_rotvec(),
        root_translations=(pelvis + motion.root_translations) @ turn.T + shift - pelvis,
    )
    before, after = (FollowingCamera.of(player, m, 96).camera_for(m[0]) for m in (motion, moved))
    back = before.camera_from_world[:3, :3] @ turn.T
    np.testing.assert_allclose(after.camera_from_world[:3, :3], back, atol=1e-9)
    np.testing.assert_allclose(after.center_world, turn @ before.center_world + shift, atol=1e-9)


def motion_of(rate, count, rng, **changes):
    roots, joints = rng.normal(size=(count, 3)), rng.normal(size=(count, 23, 3)) * 0.5
    places = np.arange(count)[:, None] * np.array([0.1, 0.0, -0.2])
    times_s = None if rate is None else 5.0 + np.arange(count) / rate
    return make_motion(roots, places, joints, "smpl", times_s=times_s, **changes)


@pytest.mark.parametrize(
    ("rate", "fps", "speed", "expected_fps", "step"),
    [
        (30.0, None, 1.0, 30.0, 1.0),
        (120.0, None, 1.0, 60.0, 2.0),
        (100.0, None, 1.0, 50.0, 2.0),
        (60.0, None, 1.0, 60.0, 1.0),
        (59.94, None, 1.0, 59.94, 1.0),
        (30.0, 24.0, 1.0, 24.0, 1.25),
        (30.0, 60.0, 1.0, 60.0, 0.5),
        (30.0, None, 0.25, 30.0, 0.25),
        (30.0, 15.0, 2.0, 15.0, 4.0),
        (None, None, 1.0, 30.0, 1.0),
        (None, 12.0, 1.0, 12.0, 1.0),
        (None, 12.0, 0.5, 12.0, 0.5),
    ],
)
def test_a_motion_keeps_its_pace(rng, rate, fps, speed, expected_fps, step):
    line = ResampledMotion.of(motion_of(rate, 41, rng), fps=fps, speed=speed)
    assert line.fps == pytest.approx(expected_fps, rel=1e-3)
    assert len(line) == int(40 / step + 1e-6) + 1
    np.testing.assert_allclose(line.positions, step * np.arange(len(line)), rtol=1e-3)


def test_its_own_pace_shows_its_own_poses(rng):
    motion = motion_of(30.0, 9, rng, valid=np.arange(9) != 4)
    line = ResampledMotion.of(motion, fps=None)
    assert [line.nearest_row(picture) for picture in range(len(line))] == [0, 1, 2, 3, 5, 6, 7, 8]
    for picture, row in enumerate((0, 1, 2, 3, 5, 6, 7, 8)):
        np.testing.assert_array_equal(
            line.pose(picture).joint_rotations, motion[row].joint_rotations
        )


def test_between_two_poses_rotations_go_the_shortest_way(rng):
    motion = motion_of(30.0, 3, rng)
    line = ResampledMotion.of(motion, fps=None, speed=0.25)
    first, pose = Rotation.from_rotvec(motion.joint_rotations[1]), line.pose(5)
    whole = (first.inv() * Rotation.from_rotvec(motion.joint_rotations[2])).magnitude()
    part = (first.inv() * Rotation.from_rotvec(pose.joint_rotations)).magnitude()
    np.testing.assert_allclose(part, 0.25 * whole, atol=1e-9)
    np.testing.assert_allclose(pose.root_translation, [0.125, 0.0, -0.25])
    np.testing.assert_allclose(line.pose(8).root_translation, motion[2].root_translation)
    assert (line.nearest_row(5), line.nearest_row(6), line.nearest_row(8)) == (1, 2, 2)

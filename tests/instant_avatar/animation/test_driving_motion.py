"""Which pose a picture shows."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from instant_avatar.animation.driving_motion import ResampledMotion
from preprocess.body.body_pose import Motion


def motion_of(rate, count, rng, *, valid=None):
    return Motion(
        root_rotations=rng.normal(size=(count, 3)),
        root_translations=np.arange(count)[:, None] * np.array([0.1, 0.0, -0.2]),
        joint_rotations=rng.normal(size=(count, 23, 3)) * 0.5,
        valid=np.ones(count, dtype=bool) if valid is None else valid,
        betas=np.zeros(10),
        body_model="smpl",
        times_s=None if rate is None else 5.0 + np.arange(count) / rate,
    )


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

"""Residuals of key points, and their derivatives against differences."""

from dataclasses import replace

import numpy as np
import pytest

from preprocess.body.proportion_space import ProportionSpace
from preprocess.fitting.clip_poses import ClipPoses
from preprocess.fitting.keypoint_rows import ClipCameras, ClipKeypoints, KeypointModel


@pytest.fixture
def problem(turning_person, mean_body, keypoint_camera, track_motion):
    """A function of step, proportions and focal length: the residuals, whose weights stay."""
    motion, space = turning_person(3), ProportionSpace.around(mean_body)
    cameras = [keypoint_camera] * 3
    found = ClipKeypoints.of(track_motion(motion), [0, 1, 2], cameras, mean_body.joints)
    model, start = KeypointModel(space), ClipPoses.of(motion, [0, 1, 2])
    seen = ClipCameras.of(cameras)

    def compare(step=np.zeros(75), coefficients=np.zeros(space.count), log_focal=0.0):  # noqa: B008 - not changed
        poses = start.moved(np.tile(step, (3, 1)), seen.rotations)
        focal = seen._replace(focal_px=seen.focal_px * np.exp(log_focal))
        return model.compare(
            poses, space.shape(coefficients).joints, focal, found, np.ones(len(found.pixels))
        )

    return compare


def test_a_person_fits_its_own_key_points(problem):
    assert np.abs(problem().residuals[:, :66]).max() < 1e-6
    assert np.abs(problem().residuals[:, 66:]).max() < 0.5  # depth: perspective is not known


def test_the_jacobian_of_poses(problem):
    for parameter in (0, 4, 8, 3 * 4, 3 * 16 + 1, 3 * 19, 3 * 15 + 2, 72, 73, 74):
        step = np.zeros(75)
        step[parameter] = 1e-5
        slope = (problem(step).residuals - problem(-step).residuals) / 2e-5
        np.testing.assert_allclose(problem().pose_jacobian[..., parameter], slope, atol=1e-3)


def test_the_jacobians_of_proportions_and_focal_length(problem):
    for coefficient in (0, 9, 11, 16, 18):
        step = np.zeros(28)
        step[coefficient] = 1e-4
        ends = problem(coefficients=step).residuals, problem(coefficients=-step).residuals
        slope = (ends[0] - ends[1]) / 2e-4
        np.testing.assert_allclose(problem().shape_jacobian[..., coefficient], slope, atol=1e-3)
    slope = (problem(log_focal=1e-5).residuals - problem(log_focal=-1e-5).residuals) / 2e-5
    np.testing.assert_allclose(problem().focal_jacobian, slope, atol=1e-3)


def test_what_is_hidden_or_lost_does_not_count(
    turning_person, mean_body, keypoint_camera, track_motion
):
    track = track_motion(turning_person(3))
    track = replace(track, presence=np.array([1.0, 0.2, 1.0]))
    track.visibility[2, 15] = 0.1
    cameras = [keypoint_camera] * 4
    found = ClipKeypoints.of(track, [0, 1, 2, 7], cameras, mean_body.joints)
    assert found.confidence[0].min() == 1.0
    assert found.confidence[[1, 3]].max() == 0.0
    assert found.confidence[2, 15] == pytest.approx(0.1)

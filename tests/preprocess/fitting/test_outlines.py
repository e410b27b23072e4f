"""Residuals of outlines and key points: their Jacobians, and what a displaced body has."""

from dataclasses import replace

import numpy as np
import pytest

from capture.camera import Camera
from preprocess.body.body_pose import BodyPose
from preprocess.body.body_surface import SkinPoints, splat_silhouette
from preprocess.body.kinematics import joint_transforms, rotation_matrices
from preprocess.body.proportion_space import ProportionSpace
from preprocess.fitting.clip_poses import ClipPoses
from preprocess.fitting.keypoint_rows import ClipCameras, ClipKeypoints, KeypointModel
from preprocess.fitting.outlines import (
    OUTLINE_SKIN_POINTS,
    OutlineDistances,
    OutlineModel,
    _Matches,
)

VIEW = np.diag([1.0, -1.0, -1.0, 1.0])
VIEW[2, 3] = 2.6
CAMERA = Camera(
    focal_px=(190.0, 190.0), center_px=(48.0, 80.0), size_px=(96, 160),
    camera_from_world=VIEW,
)  # fmt: skip


def a_pose() -> BodyPose:
    turns = np.zeros((23, 3))
    turns[[0, 1], 2] = 0.2, -0.2
    turns[[15, 16], 2] = -0.8, 0.8
    turns[17] = 0.1, 0.3, -0.2
    return BodyPose(
        root_rotation=np.array([0.1, 0.5, 0.05]), root_translation=np.array([0.02, 0.05, 0.1]),
        joint_rotations=turns,
    )  # fmt: skip


@pytest.fixture(scope="module")
def model(shaped) -> OutlineModel:
    return OutlineModel(ProportionSpace.around(shaped))


def mask_of(model: OutlineModel, pose: BodyPose) -> OutlineDistances:
    skin = SkinPoints.of(model.space.shaped, OUTLINE_SKIN_POINTS)
    alpha = splat_silhouette(skin.posed(pose), CAMERA).astype(np.float32)
    return OutlineDistances.of(alpha, CAMERA)


def world_from_rest(model: OutlineModel, pose: BodyPose) -> np.ndarray:
    """The joints' transforms, while the model has the proportions of its space's origin."""
    return model.space.shaped.with_pose(pose).world_from_rest()


def project_rows(model, rows, weights, rest, pose, camera) -> np.ndarray:
    """Pixels of rest points, skinned from scratch."""
    space = model.space
    turns = np.concatenate([pose.root_rotation[None], pose.joint_rotations])
    moved = joint_transforms(model.joints, space.shaped.body.parents, rotation_matrices(turns))
    moved[:, :3, 3] += pose.root_translation
    blended = np.einsum("rj,jab->rab", weights[rows], moved[:, :3])
    return camera.project(np.einsum("rab,rb->ra", blended[:, :, :3], rest[rows]) + blended[:, :, 3])


def test_a_body_fits_its_own_outline_within_a_pixel(model):
    seen = model.compare(world_from_rest(model, a_pose()), mask_of(model, a_pose()))
    assert np.abs(np.median(seen.residuals)) < 0.5
    assert np.percentile(np.abs(seen.residuals), 90) < 1.5


@pytest.mark.parametrize("parameter", [0, 1, 2, 3 * 16, 3 * 18 + 1, 3 * 1 + 2, 72, 73, 74])
def test_the_jacobian_of_a_pose_is_that_of_projected_skin(model, parameter):
    pose, step = a_pose(), 1e-4
    chosen = np.arange(0, len(model._rest), 400)
    normals = np.tile([0.6, 0.8], (len(chosen), 1))
    jacobian = linearise_at(model, pose, chosen, normals).pose_jacobian
    change = np.zeros(75)
    change[parameter] = step
    view = CAMERA.camera_from_world[None, :3, :3]
    weights, rest = model._weights.astype(float), model._rest.astype(float)
    ends = [
        project_rows(
            model, chosen, weights, rest,
            ClipPoses.stack([pose]).moved(sign * change[None], view)[0], CAMERA,
        )
        for sign in (1.0, -1.0)
    ]  # fmt: skip
    slope = ((ends[0] - ends[1]) * normals).sum(axis=1) / (2.0 * step)
    assert np.allclose(jacobian[:, parameter], slope, atol=0.01 * np.abs(slope).max() + 1e-3)


def linearise_at(model, pose, chosen, normals):
    transforms = world_from_rest(model, pose)
    blended = np.einsum("rj,jab->rab", model._weights[chosen], transforms[:, :3])
    points = np.einsum("rab,rb->ra", blended[:, :, :3], model._rest[chosen]) + blended[:, :, 3]
    matches = _Matches(np.arange(len(chosen)), np.zeros(len(chosen)), normals)
    return model._linearise(points.astype(np.float32), chosen, transforms, CAMERA, matches)


def test_the_jacobian_of_the_proportions_is_that_of_projected_skin(model):
    pose, step, space = a_pose(), 1e-3, model.space
    chosen = np.arange(0, len(model._rest), 400)
    normals = np.tile([0.6, 0.8], (len(chosen), 1))
    jacobian = linearise_at(model, pose, chosen, normals).shape_jacobian
    for coefficient in (0, 10, 14, 17, 20, space.count - 1):
        ends = []
        for sign in (1.0, -1.0):
            model.set_proportions(sign * step * np.eye(space.count)[coefficient])
            weights, rest = model._weights.astype(float), model._rest.astype(float)
            ends.append(project_rows(model, chosen, weights, rest, pose, CAMERA))
        model.set_proportions(np.zeros(space.count))
        slope = ((ends[0] - ends[1]) * normals).sum(axis=1) / (2.0 * step)
        assert np.allclose(jacobian[:, coefficient], slope, atol=0.05 * np.abs(slope).max() + 0.02)


@pytest.fixture
def problem(turning_person, shaped, keypoint_camera, track_motion):
    """A function of step, proportions and focal length: the residuals, whose weights stay."""
    motion, space = turning_person(3), ProportionSpace.around(shaped)
    cameras = [keypoint_camera] * 3
    found = ClipKeypoints.of(track_motion(motion), [0, 1, 2], cameras, shaped.joints)
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
    turning_person, shaped, keypoint_camera, track_motion
):
    track = track_motion(turning_person(3))
    track = replace(track, presence=np.array([1.0, 0.2, 1.0]))
    track.visibility[2, 15] = 0.1
    cameras = [keypoint_camera] * 4
    found = ClipKeypoints.of(track, [0, 1, 2, 7], cameras, shaped.joints)
    assert found.confidence[0].min() == 1.0
    assert found.confidence[[1, 3]].max() == 0.0
    assert found.confidence[2, 15] == pytest.approx(0.1)

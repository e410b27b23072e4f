"""Tests for the alignment of SMPL's poses to masks of a taller or smaller person."""

from dataclasses import replace

import numpy as np
import pytest

from capture.camera import Camera
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.mask_alignment import BodyPlacement, place_body_on_masks
from preprocess.alignment.silhouette_objective import MaskSample, SilhouetteObjective
from preprocess.body.body_pose import Motion
from preprocess.body.body_surface import SkinPoints, splat_silhouette
from preprocess.body.parametric_body import (
    ShapedBody,
    load_body_model,
    smpl_rest_joints,
    with_smpl_joints,
)
from preprocess.body.proportion_space import shape_for_motion

SIZE = (96, 128)
FRAMES = 6


@pytest.fixture(scope="module")
def turning() -> Motion:
    """A person who turns round 3.5 m in front of the camera, in the camera's axes, limbs moving."""
    rng = np.random.default_rng(3)
    roots = [
        np.pi * np.array([np.cos(yaw / 2.0), 0.0, np.sin(yaw / 2.0)])
        for yaw in np.linspace(0.0, np.pi, FRAMES)
    ]
    return Motion(
        root_rotations=np.array(roots),
        root_translations=np.array([[0.1 * row - 0.2, 0.1, 3.5] for row in range(FRAMES)]),
        joint_rotations=0.15 * rng.normal(size=(FRAMES, 23, 3)),
        valid=np.ones(FRAMES, dtype=bool),
        betas=np.ones(10),
        body_model="smpl",
    )


def scaled(shaped: ShapedBody, factor: float) -> ShapedBody:
    """The same person, taller about the pelvis."""
    pelvis = shaped.joints[0]
    return replace(
        shaped,
        vertices=pelvis + (shaped.vertices - pelvis) * factor,
        joints=pelvis + (shaped.joints - pelvis) * factor,
    )


@pytest.fixture(scope="module", params=[1.12, 0.9])
def filmed(
    request, turning
) -> tuple[ShapedBody, CaptureGeometry, SilhouetteObjective, BodyPlacement]:
    """A person with SMPL's proportions and another height; geometry; objective; placement."""
    body = load_body_model()
    own = shape_for_motion(body, turning)
    person = scaled(own, request.param)
    geometry = CaptureGeometry(
        motion=turning,
        row_frames=np.arange(FRAMES, dtype=np.float64),
        intrinsics=np.array([[[190.0, 0.0, 48.0], [0.0, 190.0, 64.0], [0.0, 0.0, 1.0]]]),
        extrinsics=np.eye(4)[None],
        size_px=SIZE,
    )
    skin = SkinPoints.of(person)
    masks = [
        splat_silhouette(skin.posed(turning[i]), geometry.camera_at(0, SIZE)) for i in range(FRAMES)
    ]
    samples = tuple(
        MaskSample(index=i, camera_row=0, alpha=mask.astype(np.float32))
        for i, mask in enumerate(masks)
    )
    objective = SilhouetteObjective(samples=samples, skin=SkinPoints.of(own))
    return person, geometry, objective, place_body_on_masks(geometry, objective)


def test_the_bodys_joints_move_exactly_as_smpls_do(turning):
    shaped = shape_for_motion(load_body_model(), turning)
    offset = shaped.joints - smpl_rest_joints()
    np.testing.assert_allclose(offset, np.broadcast_to(offset[0], (24, 3)), atol=1e-12)


def test_the_skin_moves_with_its_joints(shaped):
    moved = with_smpl_joints(shaped)
    rigid = shaped.body.weights.max(axis=1) > 0.999
    joint = shaped.body.weights[rigid].argmax(axis=1)
    before = shaped.vertices[rigid] - shaped.joints[joint]
    after = moved.vertices[rigid] - moved.joints[joint]
    np.testing.assert_allclose(after, before, atol=2e-3)


def test_poses_of_the_bodys_own_family_change_nothing(turning):
    body = load_body_model()
    own = shape_for_motion(body, replace(turning, body_model="body24", betas=np.zeros(10)))
    np.testing.assert_array_equal(own.joints, body.joints)


def test_the_height_is_found_in_the_masks(filmed):
    person, _, objective, placement = filmed
    factor = np.ptp(person.joints[:, 1]) / np.ptp(objective.skin.shaped.joints[:, 1])
    assert placement.is_improvement
    assert placement.distance_divisor == pytest.approx(factor, rel=0.02)
    assert placement.iou_after > 0.93 > placement.iou_before + 0.1


def test_joints_land_where_the_person_has_them(filmed):
    person, geometry, objective, placement = filmed
    camera: Camera = geometry.camera_at(0, SIZE)
    for row in range(FRAMES):
        pose, fitted = geometry.motion[row], placement.motion[row]
        true = camera.project(person.with_pose(pose).joints())
        found = camera.project(objective.skin.shaped.with_pose(fitted).joints())
        assert np.abs(true - found).max() < 1.2  # pixels of 2.3 cm
        np.testing.assert_array_equal(fitted.joint_rotations, pose.joint_rotations)


def test_poses_that_fit_already_stay(filmed):
    _, geometry, objective, placement = filmed
    again = place_body_on_masks(replace(geometry, motion=placement.motion), objective)
    assert not again.is_improvement

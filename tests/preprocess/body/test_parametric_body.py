"""The body in three stages, and the one that is embedded."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import preprocess
from preprocess.body.body_pose import BodyPose
from preprocess.body.kinematics import JOINT_NAMES
from preprocess.body.parametric_body import BodyModel, betas_for_motion, load_body_model


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return load_body_model()


def pose_with(**changes: np.ndarray) -> BodyPose:
    parts = {"root_rotation": np.zeros(3), "root_translation": np.zeros(3)}
    return BodyPose(**{**parts, "joint_rotations": np.zeros((23, 3)), **changes})


def test_the_embedded_body_is_a_person_in_t_pose(body):
    """Metres; y up, z out of the chest, x to the body's left."""
    low, high = body.template.min(axis=0), body.template.max(axis=0)
    assert body.family == "body24"
    assert 1.5 < (high - low)[1] < 1.9
    joints = dict(zip(JOINT_NAMES, body.joints, strict=True))
    assert joints["left_wrist"][0] > 0.5
    np.testing.assert_allclose(joints["left_wrist"][1], joints["left_shoulder"][1], atol=0.1)
    assert joints["head"][1] > joints["pelvis"][1] > joints["left_foot"][1]
    assert joints["left_foot"][2] > joints["left_ankle"][2] + 0.05
    mirrored = body.joints[[JOINT_NAMES.index(n.replace("left", "right")) for n in JOINT_NAMES]]
    np.testing.assert_allclose(mirrored[:, 1:], body.joints[:, 1:], atol=0.02)


def test_the_embedded_body_is_closed_and_turned_outwards(body):
    edges = np.sort(body.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    assert np.mean(uses == 2) > 0.99
    a, b, c = (body.template[body.faces[:, i]] for i in range(3))
    volume = np.einsum("fi,fi->f", a, np.cross(b, c)).sum() / 6.0
    assert 0.04 < volume < 0.12  # a person's 40 to 120 litres


def test_weights_sum_to_one_and_each_joint_holds_something(body):
    np.testing.assert_allclose(body.weights.sum(axis=1), 1.0, atol=1e-12)
    assert body.weights.min() >= 0.0
    assert (body.weights.max(axis=0) > 0.4).all()


def test_the_embedded_body_is_small():
    data = Path(preprocess.__file__).parent / "data"
    assert (data / "body24.npz").stat().st_size < 1.5e6
    assert "CC0" in (data / "LICENSE-body24.md").read_text()


def test_at_rest_the_body_is_its_template(body):
    posed = body.with_shape().with_pose(BodyPose.rest())
    np.testing.assert_allclose(posed.vertices(), body.template, atol=1e-12)
    np.testing.assert_allclose(posed.joints(), body.joints, atol=1e-12)


def test_betas_move_the_body_linearly_and_missing_ones_count_as_zero(body):
    betas = np.array([1.0, -0.5])
    shaped = body.with_shape(betas)
    np.testing.assert_allclose(
        shaped.vertices - body.template, body.shape_directions[..., :2] @ betas, atol=1e-12
    )
    np.testing.assert_array_equal(
        body.with_shape(np.append(betas, np.zeros(30))).joints, shaped.joints
    )


def test_the_root_carries_the_body_rigidly_about_the_pelvis(body):
    turn, shift = np.array([0.3, -1.0, 0.2]), np.array([1.0, 2.0, 3.0])
    posed = body.with_shape().with_pose(pose_with(root_rotation=turn, root_translation=shift))
    pelvis = body.joints[0]
    rotation = Rotation.from_rotvec(turn).as_matrix()
    expected = (body.template - pelvis) @ rotation.T + pelvis + shift
    np.testing.assert_allclose(posed.vertices(), expected, atol=1e-9)


def test_bending_the_elbow_moves_the_forearm_alone(body):
    bend = np.zeros((23, 3))
    elbow = JOINT_NAMES.index("left_elbow")
    bend[elbow - 1] = 0.0, -1.0, 0.0
    vertices = body.with_shape().with_pose(pose_with(joint_rotations=bend)).vertices()
    way = np.linalg.norm(vertices - body.template, axis=1)
    arm = body.weights[:, [elbow, 20, 22]].sum(axis=1)
    assert way[arm == 0.0].max() < 1e-12
    hand = body.weights[:, 22] == 1.0
    elbow_at = body.joints[elbow]
    expected = (body.template[hand] - elbow_at) @ Rotation.from_rotvec(
        bend[elbow - 1]
    ).as_matrix().T
    np.testing.assert_allclose(vertices[hand], expected + elbow_at, atol=1e-9)


def test_betas_count_only_where_model_and_body_agree(body, motion):
    np.testing.assert_array_equal(betas_for_motion(body, motion), motion.betas)
    np.testing.assert_array_equal(
        betas_for_motion(body, replace(motion, body_model="smpl")), np.zeros(10)
    )

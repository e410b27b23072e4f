"""The body in three stages, its files, the person of a motion, and proportions."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import preprocess
from capture.input_error import InputError
from preprocess.body.body_pose import BodyPose
from preprocess.body.kinematics import HEAD_JOINT, JOINT_NAMES, PARENTS
from preprocess.body.parametric_body import (
    BodyModel,
    betas_for_motion,
    load_body_model,
    smpl_rest_joints,
    with_smpl_joints,
)
from preprocess.body.proportion_space import GIRTH_GROUPS, ProportionSpace, shape_for_motion


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


def test_each_joint_holds_something(body):
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
    moved = body.shape_directions[..., :2] @ betas
    np.testing.assert_allclose(shaped.vertices - body.template, moved, atol=1e-12)
    longer = body.with_shape(np.append(betas, np.zeros(30)))
    np.testing.assert_array_equal(longer.joints, shaped.joints)


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
    turn = Rotation.from_rotvec(bend[elbow - 1])
    expected = turn.apply(body.template[hand] - elbow_at) + elbow_at
    np.testing.assert_allclose(vertices[hand], expected, atol=1e-9)


def test_betas_count_only_where_model_and_body_agree(body, motion):
    np.testing.assert_array_equal(betas_for_motion(body, motion), motion.betas)
    np.testing.assert_array_equal(
        betas_for_motion(body, replace(motion, body_model="smpl")), np.zeros(10)
    )


@pytest.fixture
def write_npz(tmp_path, smpl_arrays):
    def write(**changes):
        path = tmp_path / "body.npz"
        arrays = {k: v for k, v in {**smpl_arrays, **changes}.items() if v is not None}
        np.savez(path, **arrays)
        return path

    return write


def assert_is(body: BodyModel, arrays: dict[str, np.ndarray]) -> None:
    np.testing.assert_allclose(body.template, arrays["v_template"], atol=1e-12)
    np.testing.assert_allclose(body.weights, arrays["weights"], atol=1e-12)
    np.testing.assert_array_equal(body.faces, arrays["f"])
    np.testing.assert_array_equal(body.parents, PARENTS)
    np.testing.assert_allclose(body.joints, arrays["J_regressor"] @ arrays["v_template"])
    np.testing.assert_allclose(body.pose_directions, arrays["posedirs"])
    betas = np.linspace(-1.0, 1.0, 10)
    shaped = body.with_shape(betas)
    np.testing.assert_allclose(shaped.joints, arrays["J_regressor"] @ shaped.vertices, atol=1e-12)


def test_smpl_keys_in_an_npz_and_in_a_pickle(write_npz, tmp_path, smpl_arrays):
    path = tmp_path / "body.pkl"
    extras = {"bs_style": "lbs", "bs_type": "lrotmin", "gender": np.float64(1.0)}
    path.write_bytes(pickle.dumps({**smpl_arrays, **extras}))
    for body in (load_body_model(write_npz()), load_body_model(path)):
        assert body.family == "smpl"
        assert_is(body, smpl_arrays)


def test_our_keys_in_an_npz(write_npz, rng):
    joints, directions = rng.normal(size=(24, 3)), rng.normal(size=(24, 3, 10))
    path = write_npz(J_regressor=None, posedirs=None, J=joints, J_shapedirs=directions)
    body = load_body_model(path)
    assert body.family == "body24"
    assert body.pose_directions is None
    found = body.with_shape(np.eye(10)[3]).joints
    np.testing.assert_array_equal(found, joints + directions[..., 3])


@pytest.mark.parametrize("root", [np.int64(-1), np.int64(2**32 - 1)])
def test_both_spellings_of_no_parent_read_as_minus_one(write_npz, smpl_arrays, root):
    tree = smpl_arrays["kintree_table"].astype(np.int64)
    tree[0, 0] = root
    assert load_body_model(write_npz(kintree_table=tree)).parents[0] == -1


def test_half_precision_is_read_as_numbers(write_npz, smpl_arrays):
    halves = smpl_arrays["shapedirs"].astype(np.float16)
    np.testing.assert_array_equal(
        load_body_model(write_npz(shapedirs=halves)).shape_directions, halves
    )


def test_pose_correctives_add_up_linearly_in_the_rotations(write_npz, smpl_arrays):
    body = load_body_model(write_npz())
    pose = pose_with(joint_rotations=np.tile([0.0, 0.0, np.pi], (23, 1)))
    # at half a turn about z, R - 1 = diag(-2, -2, 0) for each of the 23 joints
    feature = np.tile(np.diag([-2.0, -2.0, 0.0]).ravel(), 23)
    rest = body.template + smpl_arrays["posedirs"] @ feature
    posed = body.with_shape().with_pose(pose)
    blended = np.einsum("vj,jab->vab", body.weights, posed.world_from_rest())
    by_hand = np.einsum("vab,vb->va", blended[:, :3, :3], rest) + blended[:, :3, 3]
    np.testing.assert_allclose(posed.vertices(), by_hand, atol=1e-9)


@pytest.mark.parametrize(
    "changes",
    [
        {"weights": None},
        {"J_regressor": None},
        {"v_template": np.zeros((40, 2))},
        {"v_template": np.full((40, 3), np.nan)},
        {"shapedirs": np.zeros((39, 3, 10))},
        {"weights": np.full((40, 24), 0.5)},
        {"f": np.full((5, 3), 40)},
        {"kintree_table": np.zeros((2, 24))},
        {"posedirs": np.zeros((40, 3, 9))},
    ],
)
def test_what_is_no_body_is_refused_by_name(write_npz, changes):
    with pytest.raises(InputError, match=r"body\.npz"):
        load_body_model(write_npz(**changes))


@pytest.mark.parametrize("name", ["body.npz", "body.pkl", "body.obj"])
@pytest.mark.parametrize("content", [None, b"", b"junk", bytes(1000), b"PK\x03\x04junk"])
def test_a_file_that_is_missing_or_something_else_is_refused(tmp_path, name, content):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name):
        load_body_model(tmp_path / name)


def test_fitted_proportions_are_the_persons_shape_whatever_the_betas(motion):
    body = load_body_model()
    space = ProportionSpace.around(body.with_shape())
    coefficients = np.linspace(-1.0, 1.0, space.count)
    shaped = shape_for_motion(body, replace(motion, proportions=coefficients))
    np.testing.assert_allclose(shaped.vertices, space.shape(coefficients).vertices)
    np.testing.assert_allclose(shaped.joints, space.shape(coefficients).joints)
    assert np.abs(shape_for_motion(body, motion).joints - shaped.joints).max() > 0.005
    strangers = replace(motion, body_model="smpl", proportions=coefficients)
    plain = shape_for_motion(body, replace(motion, body_model="smpl"))
    np.testing.assert_array_equal(shape_for_motion(body, strangers).joints, plain.joints)


def test_proportions_of_another_body_are_refused(motion):
    with pytest.raises(InputError, match="7 proportions"):
        shape_for_motion(load_body_model(), replace(motion, proportions=np.zeros(7)))


def test_the_bodys_joints_move_exactly_as_smpls_do(motion):
    shaped = shape_for_motion(load_body_model(), replace(motion, body_model="smpl"))
    offset = shaped.joints - smpl_rest_joints()
    np.testing.assert_allclose(offset, np.broadcast_to(offset[0], (24, 3)), atol=1e-12)


def test_the_skin_moves_with_its_joints(shaped):
    moved = with_smpl_joints(shaped)
    rigid = shaped.body.weights.max(axis=1) > 0.999
    joint = shaped.body.weights[rigid].argmax(axis=1)
    before = shaped.vertices[rigid] - shaped.joints[joint]
    after = moved.vertices[rigid] - moved.joints[joint]
    np.testing.assert_allclose(after, before, atol=2e-3)


THICKER = 1.5


@pytest.fixture
def space(shaped):
    return ProportionSpace.around(shaped)


def moved_by(space, group):
    """Displacement of the skin by a girth, metres."""
    coefficients = np.zeros(space.count)
    row = list(GIRTH_GROUPS).index(group)
    coefficients[space.count - len(GIRTH_GROUPS) + row] = THICKER
    return space.shape(coefficients).vertices - space.shaped.vertices


def test_hair_covers_the_skull_and_not_the_face(space):
    moved, vertices = moved_by(space, "head"), space.shaped.vertices
    weight = space.shaped.body.weights[:, HEAD_JOINT]
    nose = np.where(weight > 0.9, vertices[:, 2], -np.inf).argmax()
    crown = np.where(weight > 0.9, vertices[:, 1], -np.inf).argmax()
    back = np.where(weight > 0.9, -vertices[:, 2], -np.inf).argmax()
    assert np.linalg.norm(moved[nose]) < 0.004
    assert 0.02 < moved[crown, 1] < 0.032
    assert -0.032 < moved[back, 2] < -0.02


@pytest.mark.parametrize("group", ["head", "hands", "feet"])
def test_no_feature_is_inflated(space, group):
    """Neighbors move nearly alike: normals of their own would tear ears and fuse fingers."""
    moved, body = moved_by(space, group), space.shaped.body
    edges = np.concatenate([body.faces[:, [0, 1]], body.faces[:, [1, 2]]])
    lengths = np.linalg.norm(np.diff(space.shaped.vertices[edges], axis=1), axis=2)[:, 0]
    apart = np.linalg.norm(np.diff(moved[edges], axis=1), axis=2)[:, 0]
    fine = (lengths > 0.002) & (lengths < 0.008) & (apart > 1e-4)
    assert fine.sum() > 1000
    assert np.percentile(apart[fine] / lengths[fine], 95) < 1.2  # along normals: 5.5 to 6.6


def test_a_trunk_is_thickened_by_the_whole_girth(space):
    moved, weights = moved_by(space, "chest"), space.shaped.body.weights
    trunk = weights[:, [6, 9]].sum(axis=1) > 0.95
    assert np.median(np.linalg.norm(moved[trunk], axis=1)) > 0.9 * THICKER * 0.02

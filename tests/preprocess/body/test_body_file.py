"""Body files: SMPL's keys and ours, whole and wrong, and what both containers must agree on."""

import pickle

import numpy as np
import pytest

from capture.input_error import InputError
from preprocess.body.body_pose import BodyPose
from preprocess.body.kinematics import PARENTS
from preprocess.body.parametric_body import BodyModel, load_body_model


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


def test_smpl_keys_in_an_npz(write_npz, smpl_arrays):
    body = load_body_model(write_npz())
    assert body.family == "smpl"
    assert_is(body, smpl_arrays)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_smpl_keys_in_a_pickle_of_any_protocol(tmp_path, smpl_arrays, protocol):
    path = tmp_path / "body.pkl"
    extras = {"bs_style": "lbs", "bs_type": "lrotmin", "gender": np.float64(1.0)}
    path.write_bytes(pickle.dumps({**smpl_arrays, **extras}, protocol))
    assert_is(load_body_model(path), smpl_arrays)


def test_our_keys_in_an_npz(write_npz, rng):
    joints, directions = rng.normal(size=(24, 3)), rng.normal(size=(24, 3, 10))
    path = write_npz(J_regressor=None, posedirs=None, J=joints, J_shapedirs=directions)
    body = load_body_model(path)
    assert body.family == "body24"
    assert body.pose_directions is None
    np.testing.assert_array_equal(
        body.with_shape(np.eye(10)[3]).joints, joints + directions[..., 3]
    )


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
    pose = BodyPose(
        root_rotation=np.zeros(3),
        root_translation=np.zeros(3),
        joint_rotations=np.tile([0.0, 0.0, np.pi], (23, 1)),
    )
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


@pytest.mark.parametrize("name", ["body.npz", "body.pkl"])
@pytest.mark.parametrize("content", [b"", b"junk", bytes(1000), b"PK\x03\x04junk"])
def test_a_file_that_is_something_else_is_refused(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name):
        load_body_model(tmp_path / name)


def test_a_missing_file_or_another_suffix_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"body\.npz"):
        load_body_model(tmp_path / "body.npz")
    (tmp_path / "body.obj").write_text("v 0 0 0")
    with pytest.raises(InputError, match=r"\.obj"):
        load_body_model(tmp_path / "body.obj")

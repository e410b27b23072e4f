"""Pose files in every spelling that is read, and in those that are refused."""

from dataclasses import replace

import numpy as np
import pytest

from capture.input_error import InputError
from preprocess.poses.pose_file import write_motion
from preprocess.poses.pose_format_registry import read_poses
from tests.motions import make_track


@pytest.fixture
def write(tmp_path, motion):
    """Writes the motion in InstantAvatar's keys, with changes; None leaves a key out."""

    def write(**changes):
        arrays = {"betas": motion.betas[None], "global_orient": motion.root_rotations}
        arrays |= {"body_pose": motion.joint_rotations.reshape(6, 69)}
        arrays |= {"transl": motion.root_translations, **changes}
        path = tmp_path / "poses.npz"
        np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
        return path

    return write


def assert_same(a, b):
    for name in ("root_rotations", "root_translations", "joint_rotations", "valid", "betas"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert a.body_model == b.body_model
    for one, other in ((a.frames, b.frames), (a.times_s, b.times_s), (a.intrinsic, b.intrinsic)):
        assert (one is None) == (other is None)
        if one is not None:
            np.testing.assert_array_equal(one, other)


def test_what_is_written_is_read(tmp_path, motion):
    rich = replace(
        motion, valid=np.arange(6) != 3, frames=np.array([0, 2, 4, 7, 8, 9]),
        times_s=np.arange(6) / 25, intrinsic=np.diag([500.0, 510.0, 1.0]), body_model="smpl",
    )  # fmt: skip
    for number, wanted in enumerate((motion, rich)):
        path = tmp_path / f"{number}.npz"
        write_motion(path, wanted)
        assert_same(read_poses(path), wanted)


@pytest.fixture
def keypoints(rng):
    """Key points in four of seven frames."""
    return make_track(
        np.array([0, 1, 4, 6]), (270, 480), image_px=rng.uniform(0.0, 500.0, (4, 33, 2)),
        world_m=rng.normal(size=(4, 33, 3)), visibility=rng.uniform(size=(4, 33)),
        presence=rng.uniform(size=4), times_s=np.array([0.0, 0.5, 2.0, 3.0]),
    )  # fmt: skip


def test_proportions_and_key_points_are_read(tmp_path, motion, keypoints):
    path, wanted = tmp_path / "poses.npz", replace(motion, proportions=np.linspace(-1, 1, 28))
    write_motion(path, replace(wanted, keypoints=keypoints))
    read = read_poses(path)
    np.testing.assert_array_equal(read.proportions, wanted.proportions)
    assert read.keypoints.size_px == (270, 480)
    for name in ("frames", "image_px", "world_m", "visibility", "presence", "times_s"):
        there, here = getattr(read.keypoints, name), getattr(keypoints, name)
        np.testing.assert_allclose(there, here, rtol=1e-6)
    assert read.select_rows(np.array([1]), np.array([0])).keypoints is None
    write_motion(path, motion)
    assert read_poses(path).keypoints is None
    assert read_poses(path).proportions is None


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        ({"keypoints_px": np.zeros((3, 33, 2))}, "keypoints_px"),
        ({"keypoint_visibility": np.full((4, 33), np.nan)}, "keypoint_visibility"),
        ({"keypoint_frames": np.array([0, 4, 1, 6])}, "ascend"),
        ({"keypoint_image_size": np.array(["a", "b"])}, "keypoint_image_size"),
        ({"proportions": np.array([0.0, np.nan])}, "proportions"),
    ],
)
def test_damaged_key_points_are_refused(write, keypoints, damage, named):
    with pytest.raises(InputError, match=named):
        read_poses(write(**{**keypoints.as_arrays(), **damage}))


def test_some_rows_are_a_whole_motion_again(tmp_path, motion):
    """Also their cameras: a file with one of six would not be read."""
    cameras = np.tile(np.eye(4), (6, 1, 1))
    cameras[:, 0, 3] = np.arange(6)
    whole = replace(motion, camera_from_world=cameras)
    some = whole.select_rows(np.array([4, 2]), np.array([10, 11]))
    write_motion(tmp_path / "some.npz", some)
    again = read_poses(tmp_path / "some.npz")
    assert_same(again, some)
    assert again.camera_from_world[:, 0, 3].tolist() == [4.0, 2.0]


def test_the_three_spellings_are_one(write, motion):
    poses = np.column_stack([motion.root_rotations, motion.joint_rotations.reshape(6, 69)])
    nothing, motion = {"global_orient": None, "body_pose": None}, replace(motion, body_model="smpl")
    assert_same(read_poses(write()), motion)
    assert_same(read_poses(write(**nothing, thetas=poses)), motion)
    trans = motion.root_translations
    assert_same(read_poses(write(**nothing, transl=None, poses=poses, trans=trans)), motion)


def test_betas_of_one_row_many_rows_or_none(write, motion):
    np.testing.assert_array_equal(read_poses(write(betas=motion.betas)).betas, motion.betas)
    many = np.stack([motion.betas + 1, motion.betas - 1, np.full(10, np.nan)])
    np.testing.assert_allclose(read_poses(write(betas=many)).betas, motion.betas)
    assert read_poses(write(betas=None)).betas.shape == (0,)


def test_the_model_is_what_the_file_says_or_else_smpls(write):
    assert read_poses(write()).body_model == "smpl"
    assert read_poses(write(model=np.array("body24"))).body_model == "body24"


def test_rows_with_nan_or_marked_as_lost_are_not_valid(write, motion):
    turned, shifted = motion.root_rotations.copy(), motion.root_translations.copy()
    turned[1, 2], shifted[4, 0], shifted[3, 1] = np.nan, np.inf, 1e200
    marked = np.array([True, True, False, True, True, True])
    motion = read_poses(write(global_orient=turned, transl=shifted, valid=marked))
    assert motion.valid.tolist() == [True, False, False, False, False, True]


def test_a_camera_matrix_per_row_becomes_their_median(write):
    matrices = np.stack([np.diag([f, f, 1.0]) for f in (500.0, 520.0, 510.0, np.nan, 510.0, 510.0)])
    np.testing.assert_array_equal(read_poses(write(K=matrices)).intrinsic, np.diag([510, 510, 1]))


@pytest.mark.parametrize(
    "changes",
    [
        {"transl": None},
        {"body_pose": np.zeros((6, 60))},
        {"global_orient": np.zeros((5, 3))},
        {"betas": np.full((1, 10), np.nan)},
        {"frame": np.arange(5)},
        {"frame": np.zeros(6)},
        {"frame": np.arange(6) + 0.5},
        {"time": np.arange(7.0)},
        {"K": np.zeros((3, 3))},
    ],
)
def test_what_is_no_motion_is_refused_by_name(write, changes):
    with pytest.raises(InputError, match=r"poses\.npz"):
        read_poses(write(**changes))


def test_a_missing_damaged_or_foreign_file_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"poses\.npz"):
        read_poses(tmp_path / "poses.npz")
    for name, content in (("poses.npz", b"PK\x03\x04 and no more"), ("poses.pkl", b"")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=name):
            read_poses(tmp_path / name)


def test_a_capture_folder_stands_for_the_poses_in_it(tmp_path, motion):
    folder = tmp_path / "capture"
    (folder / "truth").mkdir(parents=True)
    for name, wanted in (("poses.npz", motion), ("dance.npz", motion.select_rows(np.arange(2)))):
        write_motion(folder / name, wanted)
    assert_same(read_poses(folder), read_poses(folder / "poses.npz"))

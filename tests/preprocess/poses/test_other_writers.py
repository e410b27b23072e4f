"""Files of programs that use other names, a file a frame, or one array for several people."""

import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture.input_error import InputError
from preprocess.poses.motion_builder import SMPLX_PELVIS, fill_gaps
from preprocess.poses.pose_format_registry import read_poses
from tests.preprocess.poses.test_trackers import World, assert_at_the_truth, npz
from tests.preprocess.poses.test_trackers import world as world


def slahmr(w: World) -> Path:
    cameras, roots, places = w.seen_from_cameras()
    both = {
        "trans": places, "root_orient": roots, "pose_body": w.thetas[:, 3:66],
        "betas": np.pad(w.betas[0], (0, 6)), "cam_R": cameras[:, :3, :3],
        "cam_t": cameras[:, :3, 3],
    }  # fmt: skip
    arrays = {key: np.stack([array, array]) for key, array in both.items()}
    mask = np.ones((2, 40), dtype=bool)
    mask[1, 9:] = False
    return w.write(
        "walk_000060_world_results.npz",
        npz(**arrays, intrins=np.array([500.0, 500, 320, 180]), track_mask=mask),
    )


def dpw(w: World) -> Path:
    cameras, roots, places = w.seen_from_cameras()
    poses = np.column_stack([roots, w.thetas[:, 3:]])
    content = {
        "poses": [poses], "trans": [places], "betas": [w.betas[0]], "genders": ["m"],
        "cam_poses": cameras, "cam_intrinsics": np.diag([500.0, 500.0, 1.0]),
    }  # fmt: skip
    return w.write("downtown_walking_00.pkl", pickle.dumps(content, 2))


def emdb(w: World) -> Path:
    cameras, roots, places = w.seen_from_cameras()
    lens = {"intrinsics": np.diag([500.0, 500.0, 1.0]), "extrinsics": cameras}
    smpl = {"poses_root": roots, "poses_body": w.thetas[:, 3:], "trans": places}
    content = {
        "gender": "male", "name": "P0_09", "n_frames": 40, "good_frames_mask": np.ones(40, bool),
        "camera": {**lens, "width": 640, "height": 360}, "smpl": {**smpl, "betas": w.betas[0]},
    }  # fmt: skip
    return w.write("P0_09_data.pkl", pickle.dumps(content, 4))


def human_nerf(w: World) -> Path:
    """metadata.json: the body stays at the origin, and the camera goes round it."""
    content = {}
    for row in range(40):
        root = Rotation.from_rotvec(w.thetas[row, :3])
        camera = np.eye(4)
        camera[:3, :3] = root.as_matrix()
        camera[:3, 3] = w.places[row] + w.rest[0] - root.apply(w.rest[0])
        content[f"frame_{row:06d}"] = {
            "poses": [0.0, 0.0, 0.0, *w.thetas[row, 3:].tolist()], "betas": w.betas[row].tolist(),
            "cam_intrinsics": np.diag([500.0, 500.0, 1.0]).tolist(),
            "cam_extrinsics": camera.tolist(),
        }  # fmt: skip
    return w.write("metadata.json", json.dumps(content).encode())


def ex_avatar(w: World) -> Path:
    for row in range(40):
        content = {
            "root_pose": w.thetas[row, :3].tolist(), "jaw_pose": [0.0] * 3, "expr": [0.0] * 50,
            "body_pose": w.thetas[row, 3:66].reshape(21, 3).tolist(),
            "trans": (w.places[row] + w.rest[0] - SMPLX_PELVIS).tolist(),
        }  # fmt: skip
        w.write(f"smplx_params/{row}.json", json.dumps(content).encode())
    return w.folder / "smplx_params"


def file_a_frame(w: World) -> Path:
    """SMPLer-X's names: frame and person; here with two people, one of them for nine frames."""
    for row in range(40):
        for person in range(1 + (row < 9)):
            where = w.places[row] + w.rest[0] - SMPLX_PELVIS + [person, 0.0, 0.0]
            arrays = {"global_orient": w.thetas[row : row + 1, :3], "transl": where[None]}
            arrays |= {"body_pose": w.thetas[row, 3:66].reshape(21, 3)}
            arrays |= {"left_hand_pose": np.zeros((15, 3)), "betas": np.zeros((1, 10))}
            w.write(f"smplx/{row + 1:05d}_{person}.npz", npz(**arrays))
    return w.folder / "smplx"


def list_of_frames(w: World) -> Path:
    rows = [
        {"frame": row, "root_orient": w.matrices[row, :1].tolist(),
         "body_pose": w.matrices[row, 1:].tolist(), "trans": w.places[row].tolist()}
        for row in reversed(range(40))
    ]  # fmt: skip
    return w.write("poses.json", json.dumps(rows).encode())


def cliff(w: World) -> Path:
    arrays = {"pose": w.thetas, "shape": w.betas, "global_t": w.places}
    arrays |= {"imgname": np.array([f"/v/{row:06d}.png" for row in range(40)])}
    return w.write("v_cliff_hr48.npz", npz(**arrays, focal_l=np.full(40, np.hypot(640, 360))))


def people_snapshot(w: World) -> Path:
    """What h5py gives of reconstructed_poses.hdf5."""
    return w.write("poses.npz", npz(pose=w.thetas, trans=w.places, betas=w.betas[0]))


def arah(w: World) -> Path:
    for row in range(40):
        arrays = {"root_orient": w.thetas[row, :3], "pose_body": w.thetas[row, 3:66]}
        arrays |= {"pose_hand": np.zeros(6), "trans": w.places[row], "betas": w.betas[row]}
        w.write(f"models/{row:06d}.npz", npz(**arrays))
    return w.folder / "models"


WRITERS = [
    slahmr, dpw, emdb, human_nerf, ex_avatar, file_a_frame, list_of_frames, cliff, people_snapshot,
    arah,
]  # fmt: skip


@pytest.mark.parametrize("write", WRITERS, ids=lambda write: write.__name__)
def test_a_file_gives_the_joints_that_were_written_to_a_millimetre(world, shaped, joints_of, write):
    motion = read_poses(write(world))
    assert motion.body_model == ("smplx" if write in (ex_avatar, file_a_frame) else "smpl")
    assert motion.valid.all()
    assert_at_the_truth(motion, world, shaped, joints_of)


def test_frames_of_a_folder_belong_to_who_is_in_their_names(world):
    motion = read_poses(file_a_frame(world))
    assert motion.frames.tolist() == list(range(1, 41))
    assert "2 people; 0 was taken" in motion.note
    other = read_poses(file_a_frame(world), person="1")
    assert other.frames.tolist() == list(range(1, 10))
    apart = other.root_translations - motion.root_translations[:9]
    np.testing.assert_allclose(apart, np.tile([1.0, 0.0, 0.0], (9, 1)), atol=1e-12)


def test_the_camera_in_lhms_files_is_the_trackers(world):
    for path in sorted(ex_avatar(world).iterdir()):
        content = json.loads(path.read_text())
        content |= {"focal": [900, 901], "princpt": [320.0, 180.0], "img_size_wh": [640, 360]}
        path.write_text(json.dumps({**content, "betas": [0.1] * 10, "pad_ratio": 0}))
    motion = read_poses(world.folder / "smplx_params")
    np.testing.assert_array_equal(motion.intrinsic, [[900, 0, 320], [0, 901, 180], [0, 0, 1]])
    assert motion.body_model == "smplx"
    np.testing.assert_allclose(motion.betas, 0.1)


def test_people_whom_slahmr_lost_are_lost_and_cameras_stay_with_their_rows(world):
    assert "1 (9 poses)" in read_poses(slahmr(world)).note
    with np.load(slahmr(world)) as stored:
        arrays = dict(stored)
    arrays["track_mask"][0, 10:13] = False
    path = world.write("gaps.npz", npz(**arrays))
    motion = read_poses(path, person="0")
    assert "3 poses that SLAHMR or 3DPW had lost" in motion.note
    cameras, _, _ = world.seen_from_cameras()
    np.testing.assert_allclose(motion.camera_from_world, cameras)


def test_a_world_that_is_not_metric_is_refused(world):
    arrays = {"global_orient": world.thetas[:, :3], "body_pose": world.thetas[:, 3:]}
    arrays["transl"] = world.places
    for scale, told in ((1.0, False), (0.37, True)):
        path = world.write("aligned.npz", npz(**arrays, scale=np.full(40, scale)))
        if not told:
            assert len(read_poses(path)) == 40
            continue
        with pytest.raises(InputError, match=r"`scale` of 0.37.*metres were expected. Divide"):
            read_poses(path)


@pytest.mark.parametrize(
    ("numbers", "model"), [(165, "smplx"), (156, "smpl"), (72, "smpl")], ids=str
)
def test_the_number_of_joints_tells_the_body(world, numbers, model):
    poses = np.column_stack([world.thetas[:, :66], np.zeros((40, numbers - 66))])
    path = world.write("poses.npz", npz(poses=poses, trans=world.places))
    motion = read_poses(path)
    assert motion.body_model == model
    np.testing.assert_allclose(motion.joint_rotations[:, :21], world.truth.joint_rotations[:, :21])
    rated = world.write("rated.npz", npz(poses=poses, trans=world.places, mocap_framerate=60.0))
    assert read_poses(rated).body_model == (model if numbers == 165 else "smpl")


def test_frames_whose_poses_have_other_shapes_do_not_fit_together(world):
    rows = json.loads(list_of_frames(world).read_text())
    rows[3]["body_pose"] = rows[3]["body_pose"][:21]
    path = world.write("poses.json", json.dumps(rows).encode())
    with pytest.raises(InputError, match="a pose a frame"):
        read_poses(path)


def test_a_motion_with_moving_cameras_of_its_own_is_not_bridged_where_a_camera_is_missing(truth):
    some = replace(
        truth, frames=np.arange(40) * 2, camera_from_world=np.tile(np.eye(4), (40, 1, 1))
    )
    assert fill_gaps(some) is some

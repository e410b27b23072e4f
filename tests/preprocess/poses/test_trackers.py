"""Each tracker's file, written as its program writes it, gives the same body in the same place."""

import collections
import io
import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from capture.camera import Camera
from capture.input_error import InputError
from preprocess.body.body_pose import Motion
from preprocess.body.kinematics import rotation_matrices
from preprocess.cameras.camera_file import CameraTrack, tracker_intrinsic_matrix
from preprocess.poses.motion_builder import (
    MAX_GAP_FRAMES,
    SMPLX_PELVIS,
    fill_gaps,
    place_in_camera_world,
)
from preprocess.poses.pose_format_registry import read_poses

SIZE = (640, 360)


class World:
    """What a writer needs to know: the truth, the body, and where to write."""

    def __init__(self, folder: Path, truth: Motion, joints, joblib_bytes):
        self.folder, self.truth, self.rest, self.joblib_bytes = folder, truth, joints, joblib_bytes
        self.thetas = np.column_stack(
            [truth.root_rotations, truth.joint_rotations.reshape(len(truth), 69)]
        )
        self.matrices = rotation_matrices(self.thetas.reshape(-1, 24, 3))
        self.betas = np.tile(truth.betas, (len(truth), 1)).astype(np.float32)
        self.places = truth.root_translations

    def anchored(self, anchor):
        """Where a point of the resting body is carried to, a row a pose."""
        pelvis = self.rest[0]
        turned = np.einsum("nab,b->na", self.matrices[:, 0], anchor - pelvis)
        return pelvis + self.places + turned

    def seen_from_cameras(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Cameras that turn and move; roots and places of the truth in the world round them."""
        turn = Rotation.from_rotvec(np.linspace([0.1, 0.0, 0.2], [0.3, 2.0, -0.1], 40))
        cameras = np.tile(np.eye(4), (40, 1, 1))  # camera from world: x = R y + t
        cameras[:, :3, :3] = turn.as_matrix()
        cameras[:, :3, 3] = np.linspace([1.0, 2.0, 3.0], [-2.0, 0.0, 4.0], 40)
        roots = (turn.inv() * Rotation.from_rotvec(self.thetas[:, :3])).as_rotvec()
        moved = self.places + self.rest[0] - cameras[:, :3, 3]
        return cameras, roots, turn.inv().apply(moved) - self.rest[0]

    def write(self, name: str, data: bytes) -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        return path


def f32(array):
    return np.asarray(array, dtype=np.float32)


def npz(**arrays) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def instant_avatar(w: World) -> Path:
    arrays = {"betas": f32(w.betas[:1]), "global_orient": f32(w.thetas[:, :3])}
    arrays |= {"body_pose": f32(w.thetas[:, 3:]), "transl": f32(w.places)}
    return w.write("poses.npz", npz(**arrays))


def superset(w: World) -> Path:
    """Our own: rows in any order, one of them lost, each seen by a camera that moves."""
    cameras, roots, places = w.seen_from_cameras()
    arrays = {
        "global_orient": roots,
        "body_pose": w.thetas[:, 3:],
        "transl": places,
        "frame": np.arange(40),
        "time": np.arange(40) / 30.0,
        "valid": np.ones(40, dtype=bool),
        "K": np.tile(np.array([[500.0, 0, 320], [0, 500, 180], [0, 0, 1]]), (40, 1, 1)),
        "camera": cameras,
    }
    again = {key: np.concatenate([rows, rows[:1]]) for key, rows in arrays.items()}
    again["valid"][-1], again["frame"][-1] = False, 40
    return w.write("poses.npz", npz(**again, model=np.array("smpl"), betas=w.betas[0]))


def matrices_without_hands(w: World) -> Path:
    held = {"global_orient": w.matrices[:, :1], "body_pose": w.matrices[:, 1:22]}
    return w.write("poses.pkl", pickle.dumps({**held, "transl": w.places, "model": "smpl"}))


def human_data(w: World) -> Path:
    smpl = {"global_orient": f32(w.thetas[:, :3]), "betas": w.betas, "transl": f32(w.places)}
    smpl["body_pose"] = f32(w.thetas[:, 3:].reshape(-1, 23, 3))
    return w.write("human.npz", npz(smpl=np.array(smpl), __data_len__=np.array(len(w.places))))


def phalp(w: World) -> Path:
    content = {}
    for row, place in enumerate(w.places):
        smpl = {"global_orient": f32(w.matrices[row, :1]), "betas": w.betas[row]}
        smpl["body_pose"] = f32(w.matrices[row, 1:])
        ghost = {**smpl, "global_orient": f32(np.eye(3)[None])}
        content[f"_DEMO/clip/img/{row + 1:06d}.jpg"] = {
            "time": row, "shot": 0, "tracked_ids": [7] if row % 3 else [7, 2], "tid": [7, 2],
            "tracked_bbox": [np.zeros(4)], "bbox": [np.zeros(4)] * 2, "tracked_time": [0, row % 3],
            "size": [[SIZE[1], SIZE[0]]] * 2, "conf": [0.9, 0.8],
            "mask": [{"size": [360, 640], "counts": b"abc"}] * 2, "smpl": [smpl, ghost],
            "camera": [f32(place), f32(place + 1.0)], "3d_joints": [f32(np.zeros((45, 3)))] * 2,
        }  # fmt: skip
    return w.write("demo_clip.pkl", w.joblib_bytes(content, compressed=True, protocol=3))


def wham(w: World) -> Path:
    results = collections.defaultdict(dict)
    for person, rows in ((0, slice(0, 9)), (np.int64(3), slice(None))):
        for key in ("", "_world"):
            results[person][f"pose{key}"] = f32(w.thetas[rows])
            results[person][f"trans{key}"] = f32(w.places[rows])
        results[person]["betas"] = w.betas[rows]
        results[person]["verts"] = f32(np.zeros((len(w.places[rows]), 30, 3)))
        results[person]["frame_ids"] = np.arange(len(w.places))[rows]
    return w.write("wham_output.pkl", w.joblib_bytes(results))


def vibe(w: World) -> Path:
    width, height = SIZE
    x, y, z = w.places.T
    across = 2.0 * 0.85 * max(SIZE) / (z * width)
    cameras = np.column_stack([across, across * width / height, x, y])
    rows = {"pred_cam": f32(cameras[:, :3]), "orig_cam": cameras, "pose": f32(w.thetas)}
    rows |= {"betas": w.betas, "joints2d": None, "verts": f32(np.zeros((40, 9, 3)))}
    rows |= {"bboxes": np.zeros((40, 4)), "frame_ids": np.arange(40)}
    return w.write("vibe_output.pkl", w.joblib_bytes({1: rows}))


def gvhmr(w: World) -> Path:
    places = w.places + w.rest[0] - SMPLX_PELVIS
    view = {"transl": torch.tensor(f32(places)), "betas": torch.zeros(40, 10)}
    view["body_pose"] = torch.tensor(f32(w.thetas[:, 3:66]))
    view["global_orient"] = torch.tensor(f32(w.thetas[:, :3]))
    focal = float(np.hypot(*SIZE))
    matrix = torch.tensor([[focal, 0, SIZE[0] / 2], [0, focal, SIZE[1] / 2], [0, 0, 1]])
    content = {"smpl_params_global": view, "smpl_params_incam": view}
    content |= {"K_fullimg": matrix.expand(40, 3, 3), "net_outputs": {"static": torch.ones(2, 3)}}
    torch.save(content, w.folder / "hmr4d_results.pt")
    return w.folder / "hmr4d_results.pt"


def tram_track(w: World) -> Path:
    tensor = torch.tensor
    results = {
        "pred_cam": torch.zeros(40, 3), "pred_pose": torch.zeros(40, 144),
        "pred_shape": tensor(w.betas), "pred_rotmat": tensor(f32(w.matrices)),
        "pred_trans": tensor(f32(w.places))[:, None], "frame": torch.arange(40),
    }  # fmt: skip
    path = w.folder / "hps" / "hps_track_0.npy"
    path.parent.mkdir()
    np.save(path, results)
    return path


def tram(w: World) -> Path:
    short = {"pred_rotmat": torch.eye(3).expand(5, 24, 3, 3), "pred_trans": torch.zeros(5, 1, 3)}
    tram_track(w)
    np.save(w.folder / "hps" / "hps_track_1.npy", {**short, "frame": np.arange(5)})
    return w.folder / "hps"


def prompthmr(w: World, **turns) -> Path:
    full = np.concatenate([w.matrices[:, :22], np.tile(np.eye(3), (40, 33, 1, 1))], axis=1)
    body = {**(turns or {"rotmat": f32(full)}), "shape": w.betas}
    body["trans"] = f32(w.places + w.rest[0] - SMPLX_PELVIS)
    people = {1: {"frames": np.arange(40), "track_id": 1, "smplx_world": body, "smplx_cam": body}}
    camera = {"img_focal": np.float32(500.0), "img_center": np.array([320.0, 180.0])}
    content = {"people": people, "camera": camera, "masks": np.zeros((40, 9, 16), dtype=bool)}
    return w.write("results.pkl", w.joblib_bytes(content))


def prompthmr_numbers(w: World) -> Path:
    """As its world's poses are: 165 numbers."""
    return prompthmr(w, pose=f32(np.column_stack([w.thetas[:, :66], np.zeros((40, 99))])))


def romp(w: World) -> Path:
    frames, rows = {}, {"frame_id": []}
    for row in range(40):
        found = {
            "smpl_thetas": f32(w.thetas[row : row + 1]), "smpl_betas": w.betas[row : row + 1],
            "cam": f32([[0.7, 0.0, 0.1]]), "cam_trans": f32(w.places[row : row + 1]),
            "track_ids": np.array([1], dtype=np.int32),
        }  # fmt: skip
        frames[f"{row:08d}.jpg"] = found
        rows["frame_id"].append(row)
        for key, value in found.items():
            rows.setdefault(key, []).append(value[0])
    results, tracks = np.array(frames, dtype=object), np.array({1: rows}, dtype=object)
    return w.write("video_results.npz", npz(results=results, sequence_results=tracks))


def romp_folder(w: World) -> Path:
    for row in range(40):
        place = w.places[row]
        found = {
            "smpl_thetas": f32([np.zeros(72), w.thetas[row]][:: 1 if row % 2 else -1]),
            "smpl_betas": np.tile(w.betas[row], (2, 1)),
            "cam_trans": f32([place + np.array([2.0, 0.0, 0.0]), place][:: 1 if row % 2 else -1]),
        }
        if row < 2:
            found = {key: value[1 if row % 2 else 0][None] for key, value in found.items()}
        w.write(f"romp/{row:08d}.npz", npz(results=np.array(found, dtype=object)))
    return w.folder / "romp"


def bev(w: World) -> Path:
    hips = w.anchored(w.rest[1:3].mean(axis=0))
    rows = {"frame_id": list(range(40)), "smpl_thetas": list(f32(w.thetas))}
    rows |= {"smpl_betas": list(np.column_stack([w.betas, np.zeros(40)]))}
    tracks = np.array({5: {**rows, "cam_trans": list(f32(hips))}}, dtype=object)
    return w.write("video_results.npz", npz(results=np.array({}), sequence_results=tracks))


def easymocap(w: World, *, annots: bool = False, short: bool = False) -> Path:
    where = w.anchored(np.zeros(3))
    for row in range(40):
        body = w.thetas[row, 3:66] if short else np.concatenate([np.zeros(3), w.thetas[row, 3:]])
        person = {"id": 4, "Rh": [w.thetas[row, :3].tolist()], "Th": [where[row].tolist()]}
        person |= {"poses": [body.tolist()], "shapes": w.betas[row : row + 1].tolist()}
        listed = [{**person, "id": 9}, person] if row < 8 else [person]
        held = {"annots": listed} if annots else listed
        w.write(f"smpl/{row:06d}.json", json.dumps(held, indent=1).encode())
    return w.folder / "smpl"


def easymocap_annots(w: World) -> Path:
    return easymocap(w, annots=True)


def easymocap_short(w: World) -> Path:
    return easymocap(w, short=True)


def zju(w: World) -> Path:
    where = w.anchored(np.zeros(3))
    (w.folder / "new_params").mkdir()
    for row in range(40):
        person = {"poses": f32(w.thetas[row][None] * ([0] * 3 + [1] * 69)), "Th": where[row][None]}
        person |= {"Rh": w.thetas[row, None, :3], "shapes": w.betas[row : row + 1]}
        np.save(w.folder / "new_params" / f"{row}.npy", person)
    return w.folder / "new_params"


def amass(w: World) -> Path:
    arrays = {"trans": w.places, "gender": np.array("neutral"), "betas": np.zeros(16)}
    arrays |= {"poses": np.column_stack([w.thetas[:, :66], np.zeros((40, 90))])}
    arrays |= {"mocap_framerate": np.array(120.0), "dmpls": np.zeros((40, 8))}
    return w.write("walk_poses.npz", npz(**arrays))


def amass_smplx(w: World) -> Path:
    arrays = {"root_orient": w.thetas[:, :3], "pose_body": w.thetas[:, 3:66]}
    arrays |= {"trans": w.places + w.rest[0] - SMPLX_PELVIS, "pose_hand": np.zeros((40, 90))}
    arrays |= {"betas": np.zeros(16), "mocap_frame_rate": np.array(120.0)}
    return w.write("walk_stageii.npz", npz(**arrays, surface_model_type=np.array("smplx")))


def aist(w: World) -> Path:
    content = {"smpl_loss": 0.5, "smpl_poses": f32(w.thetas), "smpl_scaling": f32([93.0])}
    content["smpl_trans"] = f32(w.places * 93.0)
    return w.write("gBR_sBM.pkl", pickle.dumps(content, 2))


TRACKERS = [
    instant_avatar, superset, matrices_without_hands, human_data, phalp,
    wham, vibe, gvhmr, tram_track, tram, prompthmr, prompthmr_numbers, romp, romp_folder, bev,
    easymocap, easymocap_annots, easymocap_short, zju, amass, amass_smplx, aist,
]  # fmt: skip


@pytest.fixture
def world(tmp_path, truth, shaped, joblib_bytes) -> World:
    return World(tmp_path, truth, shaped.joints, joblib_bytes)


def own_camera(motion: Motion) -> CameraTrack:
    """The camera that the tracker took, at the world's origin."""
    matrix = tracker_intrinsic_matrix(motion, SIZE)
    matrix = np.array([[500.0, 0, 320], [0, 500, 180], [0, 0, 1]]) if matrix is None else matrix
    return CameraTrack(cameras=(Camera.from_intrinsic(matrix, SIZE),), source="its own")


def assert_at_the_truth(motion: Motion, world: World, shaped, joints_of) -> None:
    """To a millimetre, as the tracker's own camera sees the joints."""
    motion = place_in_camera_world(motion, shaped, own_camera(motion), cameras_given=False)
    away = np.linalg.norm(joints_of(motion)[:40] - joints_of(world.truth), axis=-1)
    assert away.shape == (40, 24)
    assert away.max() < 1e-3


HAVE_A_WORLD = (wham, gvhmr, prompthmr, prompthmr_numbers, superset, amass)
"""Those whose poses in the world are read as such, and two that have no others."""


@pytest.mark.parametrize(
    ("write", "driving"),
    [*((write, False) for write in TRACKERS), *((write, True) for write in HAVE_A_WORLD)],
)
def test_a_file_gives_the_joints_that_were_written_to_a_millimetre(
    world, shaped, joints_of, write, driving
):
    motion = read_poses(write(world), prefer_world=driving)
    assert np.flatnonzero(motion.valid).tolist() == list(range(40))
    if write in (phalp, wham, vibe, tram, prompthmr, romp, romp_folder, easymocap):
        assert motion.frames.tolist() == list(range(40))
    if write in (phalp, wham, vibe, tram, romp, easymocap, instant_avatar):
        np.testing.assert_allclose(motion.betas, world.truth.betas, atol=1e-6)
    if write in (wham, easymocap, gvhmr, amass_smplx):
        assert motion.body_model == ("smplx" if write in (gvhmr, amass_smplx) else "smpl")
    assert_at_the_truth(motion, world, shaped, joints_of)


def test_rows_without_numbers_have_times_or_are_matched_by_order(world):
    assert read_poses(gvhmr(world)).frames is None
    np.testing.assert_allclose(read_poses(amass(world)).times_s, np.arange(40) / 120.0)
    np.testing.assert_allclose(read_poses(aist(world)).times_s, np.arange(40) / 60.0)


# --- people ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("write", "taken", "other", "rows"),
    [(phalp, "7", "2", 40), (wham, "3", "0", 9), (tram, "0", "1", 5), (easymocap, "4", "9", 8)],
)
def test_of_several_people_the_longest_is_taken_and_the_others_are_named(
    world, write, taken, other, rows
):
    path = write(world)
    motion = read_poses(path)
    assert f"2 people; {taken} was taken" in motion.note
    assert f"The others: {other} (" in motion.note
    assert "--person" in motion.note
    assert len(read_poses(path, person=taken)) == 40
    assert read_poses(path, person=other).valid.sum() in (rows, 14, 40)
    with pytest.raises(InputError, match=rf"no person called '99'.*{other} \("):
        read_poses(path, person="99")


def test_a_folder_of_romps_results_may_hold_them_twice(world):
    """Each frame's file, and video_results.npz, which knows who is who."""
    alone = read_poses(romp(world))
    romp_folder(world)
    (world.folder / "video_results.npz").rename(world.folder / "romp" / "video_results.npz")
    both = read_poses(world.folder / "romp")
    np.testing.assert_array_equal(both.root_translations, alone.root_translations)
    assert both.note == alone.note


def test_where_romp_could_not_fit_a_place_the_pose_is_lost(world):
    places = [f32(place) for place in world.places]
    places[11:30] = [f32([-1.0, -1.0, -1.0])] * 19
    rows = {"frame_id": list(range(40)), "smpl_thetas": list(f32(world.thetas))}
    rows |= {"smpl_betas": list(world.betas), "cam_trans": places}
    tracks = np.array({1: rows}, dtype=object)
    path = world.write("video_results.npz", npz(results=np.array({}), sequence_results=tracks))
    assert np.flatnonzero(~read_poses(path).valid).tolist() == list(range(11, 30))


# --- gaps --------------------------------------------------------------------------------------


def without(rows: np.ndarray, motion: Motion) -> Motion:
    kept = np.setdiff1d(np.arange(len(motion)), rows)
    return motion.select_rows(kept, motion.frames[kept])


def test_a_short_gap_is_bridged_and_a_long_one_stays(world, shaped, joints_of):
    lost = World(world.folder, without(np.r_[5:9, 15:30], world.truth), world.rest, None)
    rows = {"pose": lost.thetas, "trans": lost.places, "betas": lost.betas}
    rows["frame_ids"] = lost.truth.frames
    motion = read_poses(lost.write("w.pkl", pickle.dumps({0: rows})))
    assert motion.frames.tolist() == [*range(15), *range(30, 40)]
    assert motion.valid.all()
    assert "4 poses that WHAM had lost" in motion.note
    away = joints_of(motion) - joints_of(without(np.r_[15:30], world.truth))
    assert np.linalg.norm(away, axis=-1)[5:9].max() < 0.1  # the way between is not the truth
    assert np.delete(np.linalg.norm(away, axis=-1), range(5, 9), axis=0).max() < 1e-6


def test_a_bridge_goes_the_shortest_way_at_even_speed(truth):
    angles = np.zeros((3, 3))
    angles[:, 1] = np.deg2rad([170.0, np.nan, -160.0])
    motion = replace(
        truth,
        root_rotations=angles,
        root_translations=np.array([[0.0, 0, 3], [9, 9, 9], [0, 0, 6]]),
        joint_rotations=np.zeros((3, 23, 3)),
        valid=np.array([True, False, True]),
        frames=np.array([10, 11, 13]),
    )
    whole = fill_gaps(motion)
    assert whole.frames.tolist() == [10, 11, 12, 13]
    expected = [[0, np.deg2rad(170.0 + step), 0] for step in (0, 10, 20, 30)]
    turned = rotation_matrices(whole.root_rotations)
    np.testing.assert_allclose(turned, rotation_matrices(np.array(expected)), atol=1e-12)
    np.testing.assert_allclose(whole.root_translations[:, 2], [3, 4, 5, 6])
    far = replace(motion, frames=np.array([10, 11, 12 + MAX_GAP_FRAMES + 1]))
    assert fill_gaps(far) is far


# --- refused -----------------------------------------------------------------------------------


def wham_rows(joints: int, places: int, frames: int) -> dict:
    """WHAM's rows of one person, whose lengths need not agree."""
    rows = {"pose": np.zeros((3, 3 * joints)), "trans": np.zeros((places, 3))}
    return {0: {**rows, "frame_ids": list(range(frames))}}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"theta": np.zeros((3, 72))}, "theta"), ([1, 2, 3], "list"),
        (np.zeros((4, 72)), "holds no poses"), ([{"keypoints": [0.0] * 51}], "holds no poses"),
        (wham_rows(20, 3, 3), "20 j"), (wham_rows(24, 2, 3), "WHAM"),
        (wham_rows(24, 3, 1), "1 frame n"),
    ],
)  # fmt: skip
def test_what_holds_no_poses_is_refused_and_says_what_it_holds(tmp_path, content, message):
    path = tmp_path / "poses.pkl"
    path.write_bytes(pickle.dumps(content))
    with pytest.raises(InputError, match=message):
        read_poses(path)

"""Joints of other bodies, as their programs write them, move our body to the same places."""

import json
import re

import numpy as np
import pytest
import torch

from capture.input_error import InputError
from preprocess.body.kinematics import JOINT_NAMES, rotation_matrices
from preprocess.body.kinematics import PARENTS as TREE
from preprocess.body.parametric_body import load_body_model, smpl_rest_joints
from preprocess.body.proportion_space import shape_for_motion
from preprocess.fitting.clip_poses import ClipPoses, PosedJoints
from preprocess.fitting.joint_fitting import COMPARED_JOINTS, POINT_NAMES
from preprocess.poses.body_joints import (
    BODIES,
    MIDDLE_JOINTS,
    NAMED,
    OFFSETS_CM,
    SIDE_JOINTS,
    SOMA_JOINTS,
    SOMA_REST_CM,
)
from preprocess.poses.pose_file import write_motion
from preprocess.poses.pose_format_registry import read_poses
from tests.motions import angles_deg, posed_points

FRAMES = 5
PARENTS = np.array(TREE)
MHR_COUNT, KEY_POINT_COUNT = 127, 70
FOCAL_PX, CENTER_PX = 900.0, np.array([640.0, 360.0])


@pytest.fixture(autouse=True)
def our_joints(monkeypatch):
    """All bodies' joints lie where ours do, as in the files written here."""
    monkeypatch.setattr("preprocess.poses.body_joints.OFFSETS_CM", {})


@pytest.fixture(scope="module")
def poses() -> ClipPoses:
    """A person who turns and bends a little, 4 m before a camera, y down."""
    rng = np.random.default_rng(5)
    share = np.linspace(0.0, 1.0, FRAMES)[:, None, None]
    vectors = rng.normal(0.0, 0.15, (24, 3)) * (0.5 + share)
    vectors[:, 22:] = 0.0
    vectors[:, 0] = 0.0
    rotations = rotation_matrices(vectors)
    yaw = rotation_matrices(share[:, 0] * [0.0, 1.0, 0.0])
    rotations[:, 0] = np.diag([1.0, -1.0, -1.0]) @ yaw
    return ClipPoses(rotations=rotations, translations=share[:, 0] * [0.3, 0.0, 0.2] + [0, 0, 4.0])


@pytest.fixture(scope="module")
def places(poses, shaped):
    """Places of our joints and landmarks in the camera."""
    return posed_points(poses, shaped.joints)


def columns(body: str) -> dict:
    """Each of our points, and its number or name in a body."""
    column, sides = BODIES.index(body), ("left", "right")
    found = {point: known[column] for point, known in MIDDLE_JOINTS.items()}
    for point, known in SIDE_JOINTS.items():
        for place, side in enumerate(sides):
            one = known[column]
            if body == "SOMA" and one:
                one = side.title() + one
            elif isinstance(one, str):
                one = f"{one}.{side[0].upper()}"
            elif one:
                one = one[place]
            found[f"{side}_{point}"] = one
    return {point: one for point, one in found.items() if one is not None}


def arranged(places, body: str, count: int):
    """The places of a body's joints by their numbers."""
    joints = np.zeros((len(places), count, 3))
    for point, known in columns(body).items():
        number = SOMA_JOINTS.index(known) if body == "SOMA" else known
        joints[:, number] = places[:, POINT_NAMES.index(point)]
    return joints


def person(places, root, *, keypoints_only=False) -> dict:
    """One person in one frame, as SAM 3D Body returns it."""
    relative = (places - root)[None]
    points = arranged(relative, "MHR's key points", KEY_POINT_COUNT)[0]
    seen = points + root
    held = {
        "pred_keypoints_3d": points.tolist(), "pred_cam_t": root.tolist(),
        "pred_keypoints_2d": (FOCAL_PX * seen[:, :2] / seen[:, 2:] + CENTER_PX).tolist(),
        "focal_length": FOCAL_PX, "body_pose_params": [0.0] * 133,
    }  # fmt: skip
    if not keypoints_only:
        held["pred_joint_coords"] = arranged(relative, "MHR", MHR_COUNT)[0].tolist()
    return held


def read_back(motion) -> PosedJoints:
    person = shape_for_motion(load_body_model(), motion)
    return ClipPoses.of(motion, range(len(motion))).joints(person.joints, PARENTS)


def worst_m(motion, places):
    apart = np.linalg.norm(read_back(motion).places - places[:, :24], axis=-1)
    return apart[:, list(COMPARED_JOINTS)].mean()


ROOT, ASIDE = np.array([0.05, 0.9, 4.1]), np.array([2.0, 0.0, 0.5])
Z_UP = [1.0, 1.0, -1.0]  # of (x, z, y), y down: turned about x


def test_sam_3d_bodys_people_are_kept_apart_and_seen_by_its_camera(tmp_path, places):
    away = places + ASIDE
    frames = [
        {"frame_index": 10 + row, "people": [person(a, ROOT), person(b, ROOT + ASIDE)]}
        for row, (a, b) in enumerate(zip(places, away, strict=True))
    ]
    frames[3]["people"].reverse()
    path = tmp_path / "sam.json"
    path.write_text(json.dumps({"fps": 25, "frames": frames}))
    for name, true in (("0", places), ("1", away)):
        motion = read_poses(path, person=name)
        assert motion.space == "camera"
        np.testing.assert_array_equal(motion.frames, 10 + np.arange(FRAMES))
        np.testing.assert_allclose(np.diff(motion.times_s), 0.04)
        np.testing.assert_allclose(motion.intrinsic[:2, 2], CENTER_PX, atol=0.01)
        np.testing.assert_allclose(motion.intrinsic[[0, 1], [0, 1]], FOCAL_PX, rtol=1e-4)
        assert worst_m(motion, true) < 0.005
        assert "joints of MHR" in motion.note


def test_a_folder_of_key_points_alone_is_a_frame_each(tmp_path, places):
    for row in (0, 2, 3):
        held = person(places[row], ROOT, keypoints_only=True)
        np.savez(tmp_path / f"image_{row:04d}.npz", **held)
    motion = read_poses(tmp_path)
    np.testing.assert_array_equal(motion.frames, [0, 1, 2, 3])  # the gap is filled
    limbs = [1, 2, 4, 5, 7, 8, 16, 17, 18, 19, 20, 21]
    apart = read_back(motion).places[[0, 2, 3]] - places[[0, 2, 3], :24]
    assert np.linalg.norm(apart, axis=-1)[:, limbs].mean() < 0.005


@pytest.mark.parametrize(
    ("body", "count"), [("SMPL-H", 52), ("SMPL-X", 55), ("SMPL-X", 127), ("SOMA", 77)]
)
def test_joints_are_known_by_their_number_in_any_unit_and_axes(tmp_path, places, body, count):
    joints = arranged(places[..., [0, 2, 1]] * Z_UP, body, count)
    np.savez(tmp_path / "joints.npz", joints=100.0 * joints, fps=50.0)
    motion = read_poses(tmp_path / "joints.npz", prefer_world=True)
    y_up = places * [1.0, -1.0, -1.0]
    assert worst_m(motion, y_up) < 0.006
    np.testing.assert_allclose(np.diff(motion.times_s), 0.02)
    assert f"joints of {body}:" in motion.note


def test_annys_bones_are_known_by_their_names(tmp_path, places):
    names = columns("Anny")
    heads = np.tile(np.eye(4), (FRAMES, 1 + len(names), 1, 1))
    for number, point in enumerate(names):
        heads[:, number, :3, 3] = places[:, POINT_NAMES.index(point)][:, [0, 2, 1]] * Z_UP
    heads[:, -1, :3, 3] = heads[:, 0, :3, 3] + [0.0, 0.07, 0.0]  # as in MakeHuman's own rig
    labels = [*(names | {"pelvis": "spine05"}).values(), "root"]
    np.savez(tmp_path / "anny.npz", bone_poses=heads, bone_labels=np.array(labels))
    motion = read_poses(tmp_path / "anny.npz", prefer_world=True)
    assert worst_m(motion, places * [1.0, -1.0, -1.0]) < 0.006
    assert "joints of Anny" in motion.note
    farthest_mm = int(motion.note.rsplit(" mm", 1)[0].split()[-1])
    assert farthest_mm < 20


def test_joints_of_a_film_stay_in_the_world_of_its_cameras(tmp_path, places):
    np.savez(tmp_path / "joints.npz", joints=arranged(places, "SMPL-X", 55))
    assert worst_m(read_poses(tmp_path / "joints.npz"), places) < 0.006


def test_gem_xs_rotations_move_its_skeleton(tmp_path, poses):
    names = {point: name for point, name in columns("SOMA").items() if point in JOINT_NAMES}
    names["neck"] = "Neck1"
    turned = np.zeros((FRAMES, 77, 3))
    vectors = [poses[row] for row in range(FRAMES)]
    for point, name in names.items():
        joint = JOINT_NAMES.index(point)
        for row, pose in enumerate(vectors):
            turn = pose.root_rotation if joint == 0 else pose.joint_rotations[joint - 1]
            turned[row, SOMA_JOINTS.index(name)] = turn

    def view(root, places):
        return {
            "global_orient": torch.tensor(root), "transl": torch.tensor(places),
            "body_pose": torch.tensor(turned[:, 1:].reshape(FRAMES, 228)),
            "identity_coeffs": torch.zeros(FRAMES, 45),
            "scale_params": torch.full((FRAMES, 69), 1.1),
        }  # fmt: skip

    camera = np.tile([[FOCAL_PX, 0, 640.0], [0, FOCAL_PX, 360.0], [0, 0, 1.0]], (FRAMES, 1, 1))
    content = {
        "body_params_incam": view(turned[:, 0], poses.translations),
        "body_params_global": view(0.0 * turned[:, 0], poses.translations),
        "K_fullimg": torch.tensor(camera),
    }
    path = tmp_path / "hpe_results.pt"
    torch.save(content, path)
    seen, driven = read_poses(path), read_poses(path, prefer_world=True)
    assert (seen.space, driven.space) == ("camera", "world")
    np.testing.assert_allclose(seen.intrinsic[0, 0], FOCAL_PX)
    turned = rotation_matrices(seen.root_rotations)
    assert angles_deg(turned, poses.rotations[:, 0]).max() < np.degrees(0.1)
    assert np.abs(driven.root_rotations).max() < 0.1
    thigh = 1.1 * (SOMA_REST_CM["LeftLeg"][2] - SOMA_REST_CM["LeftShin"][2]) / 100.0
    knee = read_back(seen).places[:, 4] - read_back(seen).places[:, 1]
    np.testing.assert_allclose(np.linalg.norm(knee, axis=1), thigh, atol=0.02)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"joints": np.zeros((2, 33, 3))}, "33 joints; expected the 22"),
        ({"joints": np.zeros((2, 24, 2))}, "shape"),
        ({"joints": np.zeros((0, 24, 3))}, "shape"),
        ({"joints": np.zeros((2, 24, 3))}, "lie in one place"),
        ({"joints": np.full((2, 24, 3), np.nan)}, "no frame has all shoulders"),
        ({"joints": np.zeros((2, 30, 3)), "joint_names": [f"Joint_{n:03d}" for n in range(30)]},
         "30 joints; expected"),
        ({"joints": np.random.default_rng(0).normal(size=(2, 24, 3))}, "joints are not SMPL-H's"),
        ({"joints": np.random.default_rng(0).normal(size=(2, 52, 3)),
          "joint_names": [f"mixamorig:{n}" for n in range(52)]},
         "known by their number; other skeletons are read as .bvh or .glb"),
    ],
)  # fmt: skip
def test_what_is_no_person_is_named(tmp_path, arrays, message):
    np.savez(tmp_path / "joints.npz", **arrays)
    with pytest.raises(InputError, match=message):
        read_poses(tmp_path / "joints.npz")


def test_rotations_count_more_than_the_joints_beside_them(tmp_path, motion):
    path = tmp_path / "poses.npz"
    write_motion(path, motion)
    with np.load(path) as held:
        np.savez(path, **held, joints=np.zeros((len(motion), 24, 3)))
    np.testing.assert_array_equal(read_poses(path).joint_rotations, motion.joint_rotations)


# --- joints of the same name lie in different places ----------------------------------------------


@pytest.fixture
def own_joints(our_joints, monkeypatch):
    """Each body's joints lie where its program has them."""
    monkeypatch.setattr("preprocess.poses.body_joints.OFFSETS_CM", OFFSETS_CM)


@pytest.fixture(scope="module")
def bending() -> ClipPoses:
    """A person who turns, nods, and bends knees, elbows and back."""
    share = np.linspace(0.0, 1.0, 6)[:, None, None]
    vectors = np.random.default_rng(4).normal(0.0, 0.12, (24, 3)) * (0.5 + share)
    vectors[:, 22:] = 0.0
    vectors[:, [3, 6, 9]] = [0.1, 0.05, -0.05] * share  # a back bends as a whole
    vectors[:, 0] = share[:, 0] * [0.0, 3.0, 0.0]
    vectors[:, [4, 5], 0] += 0.6
    return ClipPoses(
        rotations=rotation_matrices(vectors), translations=share[:, 0] * [0.3, 0.0, 0.6] + [0, 1, 0]
    )


@pytest.mark.usefixtures("own_joints")
@pytest.mark.parametrize("body", ["SOMA", "SMPL-H", pytest.param(NAMED, marks=pytest.mark.slow)])
def test_our_joints_are_found_from_where_another_body_has_them(tmp_path, bending, shaped, body):
    ours, offsets = bending.joints(shaped.joints, PARENTS), np.zeros((24, 3))
    for joint, name in enumerate(JOINT_NAMES):
        point = re.sub("^(left|right)_", "", name)
        mirror = -1.0 if name.startswith("right") else 1.0
        offsets[joint] = np.array(OFFSETS_CM[body].get(point, (0, 0, 0))) * [mirror, 1, 1] / 100.0
    given = {"joints": ours.places + (ours.turns @ offsets[:, :, None])[..., 0]}
    if body == "SOMA":
        hands = {"left_hand": "LeftHandIndex2", "right_hand": "RightHandIndex2"}
        known = columns(body) | hands
        given["joint_names"] = [known[name] for name in JOINT_NAMES]
    elif body == NAMED:
        given["joint_names"] = list(JOINT_NAMES)
    np.savez(tmp_path / "joints.npz", **given)
    found = read_back(read_poses(tmp_path / "joints.npz"))
    apart = np.linalg.norm(found.places - ours.places, axis=-1)[:, :22]
    assert apart.mean(axis=0).max() < 0.015


@pytest.mark.usefixtures("own_joints")
def test_all_joints_of_smpl_are_met_within_15_mm_and_its_head_looks_the_same_way(tmp_path, bending):
    true, head = bending.joints(smpl_rest_joints(), PARENTS), [12, 15]
    np.savez(tmp_path / "joints.npz", joints=true.places)
    motion = read_poses(tmp_path / "joints.npz")
    mean, worst = map(int, re.findall(r"(\d+) mm", motion.note))
    assert mean < 8
    assert worst < 15
    assert angles_deg(read_back(motion).turns[:, head], true.turns[:, head]).mean() < 20.0

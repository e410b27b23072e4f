"""Bodies have joints of the same name in different places of the trunk; all of them are met."""

import re

import numpy as np
import pytest

from preprocess.body.kinematics import JOINT_NAMES, rotation_matrices
from preprocess.body.kinematics import PARENTS as TREE
from preprocess.body.parametric_body import load_body_model, smpl_rest_joints
from preprocess.body.proportion_space import shape_for_motion
from preprocess.fitting.clip_poses import ClipPoses, PosedJoints
from preprocess.poses.body_joints import NAMED, OFFSETS_CM, SOMA_JOINTS
from preprocess.poses.pose_format_registry import read_poses

FRAMES = 12
NECK, HEAD = JOINT_NAMES.index("neck"), JOINT_NAMES.index("head")


@pytest.fixture(scope="module")
def poses() -> ClipPoses:
    """A person who turns, nods, and bends knees, elbows and back."""
    share = np.linspace(0.0, 1.0, FRAMES)[:, None, None]
    vectors = np.random.default_rng(4).normal(0.0, 0.12, (24, 3)) * (0.5 + share)
    vectors[:, 22:] = 0.0
    vectors[:, [3, 6, 9]] = [0.1, 0.05, -0.05] * share  # a back bends as a whole
    vectors[:, 0] = share[:, 0] * [0.0, 3.0, 0.0]
    vectors[:, [4, 5], 0] += 0.6
    return ClipPoses(
        rotations=rotation_matrices(vectors), translations=share[:, 0] * [0.3, 0.0, 0.6] + [0, 1, 0]
    )


def moved(poses: ClipPoses, rest) -> PosedJoints:
    return poses.joints(rest, np.array(TREE))


def read_back(motion) -> PosedJoints:
    person = shape_for_motion(load_body_model(), motion)
    return moved(ClipPoses.of(motion, range(len(motion))), person.joints)


@pytest.mark.parametrize("body", ["SOMA", "SMPL-H", NAMED])
def test_our_joints_are_found_from_where_another_body_has_them(tmp_path, poses, body):
    ours = moved(poses, load_body_model().with_shape().joints)
    offsets = np.zeros((24, 3))
    for joint, name in enumerate(JOINT_NAMES):
        point = re.sub("^(left|right)_", "", name)
        mirror = -1.0 if name.startswith("right") else 1.0
        offsets[joint] = np.array(OFFSETS_CM[body].get(point, (0, 0, 0))) * [mirror, 1, 1] / 100.0
    places = ours.places + (ours.turns @ offsets[:, :, None])[..., 0]
    names = list(JOINT_NAMES)
    if body == "SOMA":
        soma = {"pelvis": "Hips", "spine1": "Spine1", "spine2": "Spine2", "spine3": "Chest",
                "neck": "Neck2", "head": "Head"}  # fmt: skip
        parts = {"hip": "Leg", "knee": "Shin", "ankle": "Foot", "foot": "ToeBase",
                 "collar": "Shoulder", "shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand",
                 "hand": "HandIndex2"}  # fmt: skip
        for joint, name in enumerate(JOINT_NAMES):
            side, _, part = name.rpartition("_")
            names[joint] = soma.get(name) or side.title() + parts[part]
        assert set(names) <= set(SOMA_JOINTS)
    given = {"joints": places} if body == "SMPL-H" else {"joints": places, "joint_names": names}
    np.savez(tmp_path / "joints.npz", **given)
    found = read_back(read_poses(tmp_path / "joints.npz"))
    apart = np.linalg.norm(found.places - ours.places, axis=-1)[:, :22]
    assert apart.mean(axis=0).max() < 0.015


def test_all_joints_of_smpl_are_met_within_15_mm_and_its_head_looks_the_same_way(tmp_path, poses):
    true = moved(poses, smpl_rest_joints())
    np.savez(tmp_path / "joints.npz", joints=true.places)
    motion = read_poses(tmp_path / "joints.npz")
    mean, worst = map(int, re.findall(r"(\d+) mm", motion.note))
    assert mean < 8
    assert worst < 15
    turns = read_back(motion).turns[:, [NECK, HEAD]]
    cosine = np.trace(turns.swapaxes(-1, -2) @ true.turns[:, [NECK, HEAD]], axis1=-2, axis2=-1)
    degrees = np.degrees(np.arccos(np.clip((cosine - 1.0) / 2.0, -1.0, 1.0)))
    assert degrees.mean() < 20.0

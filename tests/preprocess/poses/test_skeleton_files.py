"""BVH and glTF as other programs write them move SMPL's joints as the truth does."""

import json
import re
import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture.input_error import InputError
from preprocess.body.kinematics import JOINT_NAMES, PARENTS, rotation_matrices
from preprocess.body.parametric_body import load_body_model
from preprocess.body.proportion_space import shape_for_motion
from preprocess.fitting.clip_poses import ClipPoses
from preprocess.poses.pose_format_registry import read_poses
from tests.motions import angles_deg
from tests.preprocess.poses.test_body_joints import columns

SIDED = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist")
AXIS = ("pelvis", "spine1", "spine2", "spine3", "neck", "head")


def named(axis: str, limbs: str, pattern: str) -> dict[str, str]:
    """Another program's names by SMPL's; `pattern` joins a side and a limb."""
    names: dict[str, str] = {}
    names.update(zip(AXIS, axis.split(), strict=True))
    for side in ("left", "right"):
        for joint, limb in zip(SIDED, limbs.split(), strict=True):
            fields = {"side": side, "Side": side.title(), "S": side[0].upper(), "limb": limb}
            fields["s"] = side[0]
            names[f"{side}_{joint}"] = pattern.format(**fields)
    return names


MIXAMO = named(
    " ".join(f"mixamorig:{name}" for name in ("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head")),
    "UpLeg Leg Foot ToeBase Shoulder Arm ForeArm Hand", "mixamorig:{Side}{limb}",
)  # fmt: skip
BLENDER = named("hips spine spine.001 chest neck head",
                "thigh shin foot toe shoulder upper_arm forearm hand", "{limb}.{S}")  # fmt: skip
VRM = named("hips spine chest upperChest neck head",
            "UpperLeg LowerLeg Foot Toes Shoulder UpperArm LowerArm Hand",
            "{side}{limb}")  # fmt: skip
MHR = named("root c_spine0 c_spine1 c_spine3 c_neck c_head",
            "upleg lowleg foot ball clavicle uparm lowarm wrist", "{s}_{limb}")  # fmt: skip
SMPL = {name: name for name in JOINT_NAMES}
NUMBERS = columns("MHR")
"""MHR's numbers of SMPL's joints."""
FRAMES = 6


@pytest.fixture(scope="module")
def truth():
    """Joint rotations of a person who starts in a T, bends everything and turns; pelvis, metres."""
    generator = np.random.default_rng(4)
    share = np.linspace(0.0, 1.0, FRAMES)[:, None, None]
    rotations = share * generator.normal(0.0, 0.35, (24, 3))
    rotations[:, 0, 1] += 1.5 * share[:, 0, 0]
    rotations[:, 22:] = 0.0
    places = np.array([0.3, 0.9, -0.2]) + share[:, 0] * [0.5, 0.1, 1.0]
    return rotations, places


class Rig:
    """SMPL's tree under other names, in another unit, up-axis and orientation of joints."""

    def __init__(self, names, *, unit=1.0, up=None, twist=None):
        rest = load_body_model().joints
        self.joints = [j for j, name in enumerate(JOINT_NAMES) if name in names]
        self.names = [names[JOINT_NAMES[j]] for j in self.joints]
        self.parents = [self.joints.index(PARENTS[j]) if j else -1 for j in self.joints]
        self.up = np.eye(3) if up is None else up
        self.unit = unit
        generator = np.random.default_rng(1)
        count = len(self.joints)
        self.axes = (
            Rotation.from_rotvec(twist * generator.normal(size=(count, 3))).as_matrix()
            if twist
            else np.tile(np.eye(3), (count, 1, 1))
        )  # of each joint in the T, in the world
        self.offsets = np.zeros((count, 3))
        for row, (joint, parent) in enumerate(zip(self.joints, self.parents, strict=True)):
            if parent >= 0:
                bone = self.up @ (rest[joint] - rest[PARENTS[joint]])
                self.offsets[row] = unit * self.axes[parent].T @ bone

    def locals(self, rotations):
        """Rotations of all joints in their parents' axes."""
        turned = rotation_matrices(rotations)
        world = [turned[:, 0]]
        for joint in range(1, 24):
            world.append(world[PARENTS[joint]] @ turned[:, joint])
        world = np.stack(world, axis=1)[:, self.joints]
        world = self.up @ world @ self.up.T @ self.axes
        local = world.copy()
        for row, parent in enumerate(self.parents):
            if parent >= 0:
                local[:, row] = world[:, parent].swapaxes(-1, -2) @ world[:, row]
        return local

    def bvh(self, rotations, places, order="ZXY", fps=60.0):
        def block(row, depth):
            pad, offset = "\t" * depth, " ".join(f"{x:.6f}" for x in self.offsets[row])
            kinds = ["Xposition", "Yposition", "Zposition"] if row == 0 else []
            kinds += [f"{axis}rotation" for axis in order]
            lines = [f"{pad}{'JOINT' if row else 'ROOT'} {self.names[row]}", f"{pad}{{",
                     f"{pad}\tOFFSET {offset}",
                     f"{pad}\tCHANNELS {len(kinds)} {' '.join(kinds)}"]  # fmt: skip
            rows.append(row)
            children = [r for r, parent in enumerate(self.parents) if parent == row]
            for child in children:
                lines += block(child, depth + 1)
            if not children:
                lines += [f"{pad}\tEnd Site", f"{pad}\t{{", f"{pad}\t\tOFFSET 0 1 0", f"{pad}\t}}"]
            return [*lines, f"{pad}}}"]

        rows: list[int] = []
        lines = ["HIERARCHY", *block(0, 0), "MOTION", f"Frames: {len(rotations)}",
                 f"Frame Time: {1.0 / fps:.8f}"]  # fmt: skip
        local = self.locals(rotations)
        for frame in range(len(rotations)):
            numbers = list(self.unit * self.up @ places[frame])
            for row in rows:
                numbers += list(
                    Rotation.from_matrix(local[frame, row]).as_euler(order, degrees=True)
                )
            lines.append(" ".join(f"{x:.6f}" for x in numbers))
        return ("\n".join(lines) + "\n").encode()

    def glb(self, rotations, places, fps=25.0):
        local, nodes, views, accessors, binary = self.locals(rotations), [], [], [], bytearray()

        def add(array, kind):
            array = np.ascontiguousarray(array, dtype="<f4")
            view = {"buffer": 0, "byteOffset": len(binary), "byteLength": array.nbytes}
            views.append(view)
            accessors.append({"bufferView": len(views) - 1, "componentType": 5126,
                              "count": len(array), "type": kind})  # fmt: skip
            binary.extend(array.tobytes())
            return len(accessors) - 1

        times = add(np.arange(len(rotations)) / fps, "SCALAR")
        rest = self.locals(np.zeros((1, 24, 3)))[0]
        samplers, channels = [], []
        for row, name in enumerate(self.names):
            children = [r for r, parent in enumerate(self.parents) if parent == row]
            at_rest = Rotation.from_matrix(rest[row]).as_quat()
            node = {"name": name, "translation": self.offsets[row].tolist(),
                    "rotation": at_rest.tolist()}  # fmt: skip
            nodes.append(node | ({"children": children} if children else {}))
            quaternions = Rotation.from_matrix(local[:, row]).as_quat()
            for path, values, kind in (
                ("rotation", quaternions, "VEC4"),
                ("translation", self.unit * places @ self.up.T, "VEC3"),
            ):
                if path == "rotation" or row == 0:
                    samplers.append({"input": times, "output": add(values, kind)})
                    channels.append({"sampler": len(samplers) - 1,
                                     "target": {"node": row, "path": path}})  # fmt: skip
        text = json.dumps({
            "asset": {"version": "2.0"}, "nodes": nodes, "bufferViews": views,
            "accessors": accessors, "buffers": [{"byteLength": len(binary)}],
            "animations": [{"samplers": samplers, "channels": channels}],
        }).encode()  # fmt: skip
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def poses_of(truth, rest) -> ClipPoses:
    rotations, places = truth
    return ClipPoses(rotations=rotation_matrices(rotations), translations=places - rest[0])


def assert_moves_as(truth, motion):
    """To 5 mm and half a degree; legs are equal."""
    rest, parents = load_body_model().joints, np.array(PARENTS)
    true, ours = poses_of(truth, rest), ClipPoses.of(motion, range(len(motion)))
    apart = ours.joints(rest, parents).places - true.joints(rest, parents).places
    assert np.abs(apart).max() < 0.005
    assert angles_deg(ours.rotations, true.rotations)[:, :22].max() < 0.5


@pytest.mark.parametrize(
    ("names", "changes"),
    [
        (SMPL, {}),
        (MIXAMO, {"unit": 100.0}),
        (BLENDER, {"up": Z_UP}),
        (MHR, {"unit": 100.0, "twist": 0.4}),
        (VRM, {"unit": 39.37, "twist": 1.0}),  # joints of any orientation, as LaFAN's are
    ],
    ids=["SMPL", "Mixamo", "Blender, z up", "MHR", "joints turned"],
)
@pytest.mark.parametrize("form", ["bvh", "glb"])
def test_a_skeleton_of_any_names_units_and_axes_moves_as_the_truth(
    truth, tmp_path, names, changes, form
):
    path = tmp_path / f"walk.{form}"
    path.write_bytes(getattr(Rig(names, **changes), form)(*truth))
    motion = read_poses(path)
    assert_moves_as(truth, motion)
    rate = {"bvh": 60.0, "glb": 25.0}[form]
    assert motion.times_s is not None
    np.testing.assert_allclose(motion.times_s, np.arange(FRAMES) / rate, atol=1e-5)


def refuse(path, data, reason):
    path.write_bytes(data)
    with pytest.raises(InputError, match=reason):
        read_poses(path)


def numbered(pattern):
    return {name: pattern.format(NUMBERS[name]) for name in JOINT_NAMES if NUMBERS.get(name)}


@pytest.fixture
def our_joints(monkeypatch):
    """MHR's joints lie where ours do, as in the files that `Rig` writes."""
    monkeypatch.setattr("preprocess.poses.body_joints.OFFSETS_CM", {})


@pytest.mark.usefixtures("our_joints")
def test_comfyuis_bvh_of_mhr_is_read_by_the_numbers_of_its_joints(truth, tmp_path):
    names = numbered("joint_{:03d}") | {"pelvis": "Hips"}
    path = tmp_path / "sam3dbody.bvh"
    path.write_bytes(Rig(names, unit=100.0, twist=0.7).bvh(*truth))
    motion = read_poses(path)
    assert motion.program == "SAM 3D Body"
    assert "joints of MHR" in motion.note
    assert motion.times_s[-1] == pytest.approx((FRAMES - 1) / 60.0)
    assert fitted_m(motion, truth) < 0.005


def fitted_m(motion, truth):
    """Mean distance of limbs' joints, each body in its own proportions; floors differ."""
    space = [shape_for_motion(load_body_model(), motion), load_body_model().with_shape()]
    own, true = ClipPoses.of(motion, range(len(motion))), poses_of(truth, space[1].joints)
    ours, theirs = (
        poses.joints(body.joints, np.array(PARENTS)).places
        for poses, body in zip((own, true), space, strict=True)
    )
    limbs = [JOINT_NAMES.index(f"{side}_{name}") for side in ("left", "right")
             for name in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")]  # fmt: skip
    return np.linalg.norm(ours - theirs, axis=-1)[:, limbs].mean()


def edited(data, change):
    """A .glb whose JSON went through `change`."""
    size = struct.unpack_from("<I", data, 12)[0]
    content = json.loads(data[20 : 20 + size])
    change(content)
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    return data[:12] + struct.pack("<I4s", len(text), b"JSON") + text + data[20 + size :]


def add_person(content):
    """The same person once more, 2 m aside."""
    nodes, (animation,) = content["nodes"], content["animations"]
    count, channels = len(nodes), animation["channels"]
    moved = json.loads(json.dumps(nodes))
    for node in moved:
        node["children"] = [child + count for child in node.get("children", [])]
    nodes += [*moved, {"name": "track00", "children": [0]},
              {"name": "track01", "children": [count], "translation": [2.0, 0.0, 0.0]}]  # fmt: skip
    channels += [
        each | {"target": each["target"] | {"node": each["target"]["node"] + count}}
        for each in channels
    ]


@pytest.mark.usefixtures("our_joints")
def test_people_of_comfyuis_glb_are_kept_apart(truth, tmp_path):
    path = tmp_path / "all_tracks.glb"
    path.write_bytes(edited(Rig(numbered("bone_{:03d}"), twist=0.7).glb(*truth), add_person))
    rotations, places = truth
    motion = read_poses(path, person="track01")
    assert fitted_m(motion, (rotations, places + np.array([2.0, 0.0, 0.0]))) < 0.005


def test_numbers_of_another_skeleton_are_named(truth, tmp_path):
    names = numbered("Joint_{:03d}") | {"pelvis": "Hips", "head": "Joint_114"}
    reason = r"other\.bvh.*not as MHR's 127.*113 \(head\)"
    refuse(tmp_path / "other.bvh", Rig(names).bvh(*truth), reason)


def test_joints_under_the_names_of_others_are_refused_by_their_bones(truth, tmp_path):
    """As where MHR's joints are taken for SMPL's: the left knee is then a foot."""
    rig = Rig(MIXAMO, unit=100.0)
    knee, ankle = (rig.names.index(MIXAMO[f"left_{name}"]) for name in ("knee", "ankle"))
    rig.offsets[knee], rig.offsets[ankle] = 2.0 * rig.offsets[knee], 0.2 * rig.offsets[ankle]
    reason = r"not those of a person.*left thigh 1\.00, left shin 0\.1"
    refuse(tmp_path / "wrong.bvh", rig.bvh(*truth), reason)


def test_a_gltf_whose_motion_holds_no_t_is_read_by_its_rest_pose(truth, tmp_path):
    """Joints of any orientation, and only the poses that are bent most."""
    rotations, places = (each[FRAMES // 2 :] for each in truth)
    path = tmp_path / "bent.glb"
    path.write_bytes(Rig(VRM, unit=39.37, twist=1.0).glb(rotations, places))
    assert_moves_as((rotations, places), read_poses(path))


def test_a_chain_of_five_vertebrae_bends_as_a_whole(truth, tmp_path):
    """Of more joints than SMPL has, the chest's own rotation is what counts."""
    rotations = np.zeros_like(truth[0])
    rotations[:, JOINT_NAMES.index("spine2"), 0] = np.linspace(0.0, 0.8, FRAMES)
    text = Rig(MIXAMO).bvh(rotations, truth[1]).decode()
    path = tmp_path / "bow.bvh"
    path.write_text(text.replace("mixamorig:Spine1", "Vertebra"))
    np.testing.assert_allclose(read_poses(path).joint_rotations, rotations[:, 1:], atol=0.01)


def test_a_skeleton_of_no_person_is_refused_by_the_joints_that_it_lacks(truth, tmp_path):
    data = Rig(MIXAMO).bvh(*truth).replace(b"mixamorig:LeftForeArm", b"mixamorig:FrontPaw")
    refuse(tmp_path / "dog.bvh", data, r"dog\.bvh.*left_elbow.*FrontPaw")


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda data: data[: data.index(b"MOTION")], "the part MOTION is missing"),
        (lambda data: data.replace(b"Frame Time", b"Zeit"), "Frame Time"),
        (lambda data: data[: data.index(b"Frame Time")] + b"Frame Time: 0.03\n1 2 3", "no frames"),
        (lambda data: data[: data.index(b"MOTION") + 8], "its parts do not fit together"),
        (lambda data: re.sub(rb"OFFSET.*", b"OFFSET 0 0 0", data), "in different, finite places"),
        (lambda data: re.sub(rb"(?m)^-?\d\S* ", b"nan ", data), "in different, finite places"),
        (lambda data: b"a letter", "it is of no kind that is known"),
    ],
)
def test_a_damaged_file_is_refused_with_its_cause(truth, tmp_path, spoil, reason):
    refuse(tmp_path / "broken.bvh", spoil(Rig(MIXAMO).bvh(*truth)), reason)


def test_a_file_cut_short_gives_the_frames_that_it_has(truth, tmp_path):
    path = tmp_path / "cut.bvh"
    lines = Rig(MIXAMO).bvh(*truth).splitlines()
    path.write_bytes(b"\n".join(lines[:-3]))
    assert len(read_poses(path)) == FRAMES - 3


def test_a_model_without_an_animation_is_named(truth, tmp_path):
    still = edited(Rig(VRM).glb(*truth), lambda content: content["animations"].clear())
    refuse(tmp_path / "still.vrm", still, "no animation")


def test_a_vrma_is_read_by_its_humanoid_bones_whatever_the_nodes_are_called(truth, tmp_path):
    def as_vrma(content):
        bones = {node["name"]: {"node": number} for number, node in enumerate(content["nodes"])}
        for number, node in enumerate(content["nodes"]):
            node["name"] = f"Knochen {number}"
        animation = {"specVersion": "1.0", "humanoid": {"humanBones": bones}}
        content["extensionsUsed"] = ["VRMC_vrm_animation"]
        content["extensions"] = {"VRMC_vrm_animation": animation}

    path = tmp_path / "walk.vrma"
    path.write_bytes(edited(Rig(VRM, twist=1.0).glb(*truth), as_vrma))
    assert_moves_as(truth, read_poses(path))


def test_nodes_that_are_their_own_ancestors_are_refused(truth, tmp_path):
    def in_a_circle(content):
        content["nodes"][-1]["children"] = [0]

    circle = edited(Rig(VRM).glb(*truth), in_a_circle)
    refuse(tmp_path / "circle.glb", circle, "their own ancestors")

"""Files of other bodies' joints: MHR (SAM 3D Body), SOMA (GEM-X), Anny, SMPL-H and SMPL-X.

One table says where each body has our joints; whatever a program calls its arrays, the places are
brought into one order, and our body is fitted to them (`preprocess.fitting.joint_fitting`).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from capture.camera import Matrix3, Vector3
from preprocess.body.body_pose import DIAGONAL_FOCAL, Motion, PoseSpace
from preprocess.body.kinematics import (
    JOINT_NAMES,
    JointPlaces,
    axis_angles_from_matrices,
    rotation_matrices,
)
from preprocess.fitting.joint_fitting import (
    COMPARED_JOINTS,
    POINT_NAMES,
    fit_joints,
    rows_with_limbs,
)
from preprocess.frame_association import frame_numbers_from_names
from preprocess.poses.motion_builder import MotionByPerson, build_motion
from preprocess.poses.skeleton_motion import find_upright
from preprocess.poses.tracker_files import nearest_person

BODIES = ("MHR", "MHR's key points", "SOMA", "Anny", "SMPL-H", "SMPL-X")
"""Bodies whose joints are known: the columns of the tables."""
MIDDLE_JOINTS = {
    "pelvis": (1, None, "Hips", "spine05", 0, 0), "spine1": (35, None, "Spine1", "spine04", 3, 3),
    "spine2": (36, None, "Spine2", "spine03", 6, 6), "spine3": (37, None, "Chest", "spine02", 9, 9),
    "neck": (111, 69, "Neck2", "neck01", 12, 12), "head": (113, None, "Head", "head", 15, 15),
    "nose": (None, 0, None, None, None, None),
}  # fmt: skip
"""Joints on the body's axis: their number or name in each body, or None."""
SIDE_JOINTS = {
    "hip": ((2, 18), (9, 10), "Leg", "upperleg01", (1, 2), (1, 2)),
    "knee": ((3, 19), (11, 12), "Shin", "lowerleg01", (4, 5), (4, 5)),
    "ankle": ((4, 20), (13, 14), "Foot", "foot", (7, 8), (7, 8)),
    "foot": ((8, 24), None, "ToeBase", "toe2-1", (10, 11), (10, 11)),
    "collar": ((74, 38), None, "Shoulder", "clavicle", (13, 14), (13, 14)),
    "shoulder": ((75, 39), (5, 6), "Arm", "upperarm01", (16, 17), (16, 17)),
    "elbow": ((76, 40), (7, 8), "ForeArm", "lowerarm01", (18, 19), (18, 19)),
    "wrist": ((78, 42), (62, 41), "Hand", "wrist", (20, 21), (20, 21)),
    "eye": ((125, 123), (1, 2), "Eye", "eye", None, (23, 24)),
    "ear": (None, (3, 4), None, None, None, None),
    "index": ((92, 56), (49, 28), "HandIndex2", "finger2-1", (22, 37), (25, 40)),
    "pinky": ((80, 44), (61, 40), "HandPinky2", "finger5-1", (28, 43), (31, 46)),
    "thumb": ((97, 61), None, "HandThumb2", "finger1-2", (35, 50), (38, 53)),
    "toe": (None, (15, 18), "ToeEnd", None, None, None),
    "heel": (None, (17, 20), None, None, None, None),
}  # fmt: skip
"""Joints of the left and the right; names are the left's without the side."""
NAMED = "a skeleton"
"""The body of joints that are known by our own names, which are SMPL's."""
SMPL_OFFSETS_CM = {
    "pelvis": (0.0, 4.9, 0.1), "spine1": (0.0, 7.6, 2.1), "spine2": (0.0, 13.4, 1.6),
    "spine3": (0.0, 8.8, 2.2), "neck": (0.0, 0.7, 1.5), "head": (0.0, -1.1, 0.7),
    "hip": (-3.1, -2.3, -1.1), "collar": (5.3, -3.7, -0.2), "shoulder": (0.7, 0.9, -0.2),
}  # fmt: skip
"""Where SMPL has joints of the trunk, from ours in our rest pose, centimetres: of the left side."""
OFFSETS_CM = {
    "MHR": {
        "pelvis": (0.0, -1.0, -1.2), "spine1": (0.0, 2.9, 2.0), "spine2": (0.0, 5.7, -1.8),
        "spine3": (0.0, 13.1, -2.5), "neck": (0.0, 0.9, 3.0), "head": (0.0, -3.3, 1.2),
        "hip": (-2.8, -1.6, 0.0), "collar": (-1.1, -2.3, 4.6), "shoulder": (-0.8, 1.4, 0.3),
    },
    "MHR's key points": {
        "neck": (0.0, -0.9, 3.9), "hip": (-2.4, -0.4, 0.1), "shoulder": (-0.9, 0.8, 1.3),
    },
    "SOMA": {
        "pelvis": (0.0, 5.8, -2.9), "spine1": (0.0, 2.5, 1.3), "spine2": (0.0, 2.2, -0.4),
        "spine3": (0.0, 0.4, -0.9), "neck": (0.0, 2.6, 0.6), "head": (0.0, -1.5, 0.7),
        "hip": (-1.1, -1.0, 0.0), "collar": (-1.0, -0.7, 0.7), "shoulder": (-0.5, -0.2, -0.2),
    },
    "SMPL-H": SMPL_OFFSETS_CM, "SMPL-X": SMPL_OFFSETS_CM, NAMED: SMPL_OFFSETS_CM,
}  # fmt: skip
"""The same for other bodies (Anny's joints are ours; joints of SMPL's names are SMPL's). Means of
fits to published persons and to mean skeletons that dance (dev/log/captures.md)."""
COUNTS = {
    22: "SMPL-H", 24: "SMPL-H", 52: "SMPL-H", 55: "SMPL-X", 70: "MHR's key points", 73: "SMPL-H",
    77: "SOMA", 127: "SMPL-X", 144: "SMPL-X",
}  # fmt: skip
"""The body by its number of joints, where a file names none (127 under MHR's own keys: MHR)."""
SOMA_JOINTS = (
    "Hips", "Spine1", "Spine2", "Chest", "Neck1", "Neck2", "Head", "HeadEnd", "Jaw", "LeftEye",
    "RightEye",
    *(
        f"{side}{name}"
        for side in ("Left", "Right")
        for name in ("Shoulder", "Arm", "ForeArm", "Hand", "HandThumb1", "HandThumb2", "HandThumb3",
                     "HandThumbEnd", *(f"Hand{finger}{end}"
                                       for finger in ("Index", "Middle", "Ring", "Pinky")
                                       for end in ("1", "2", "3", "4", "End")))
    ),
    *(f"{side}{name}" for side in ("Left", "Right")
      for name in ("Leg", "Shin", "Foot", "ToeBase", "ToeEnd")),
)  # fmt: skip
"""SOMA's joints in their order, without the virtual root."""
SOMA_REST_CM = {
    "Hips": ("", 0.0, 101.2, 0.0), "Spine1": ("Hips", 0.0, 106.3, 0.0),
    "Spine2": ("Spine1", 0.0, 113.5, 0.0), "Chest": ("Spine2", 0.0, 120.8, -0.8),
    "Neck1": ("Chest", 0.0, 147.1, -0.9), "Neck2": ("Neck1", 0.0, 154.7, 1.3),
    "Head": ("Neck2", 0.0, 161.0, 3.4), "LeftEye": ("Head", 3.1, 166.3, 11.0),
    "LeftShoulder": ("Chest", 1.6, 144.2, 4.1), "LeftArm": ("LeftShoulder", 16.4, 144.2, -1.3),
    "LeftForeArm": ("LeftArm", 45.3, 144.2, -1.3), "LeftHand": ("LeftForeArm", 72.3, 144.2, -1.3),
    "LeftHandThumb1": ("LeftHand", 74.4, 142.8, 1.8),
    "LeftHandThumb2": ("LeftHandThumb1", 78.4, 141.0, 3.5),
    "LeftHandIndex1": ("LeftHand", 75.5, 143.7, 0.9),
    "LeftHandIndex2": ("LeftHandIndex1", 81.8, 143.7, 1.1),
    "LeftHandPinky1": ("LeftHand", 75.2, 143.9, -3.0),
    "LeftHandPinky2": ("LeftHandPinky1", 80.2, 142.6, -4.8),
    "LeftLeg": ("Hips", 10.0, 92.9, 2.2), "LeftShin": ("LeftLeg", 10.0, 49.6, 2.2),
    "LeftFoot": ("LeftShin", 10.0, 7.2, 2.2), "LeftToeBase": ("LeftFoot", 10.0, 2.2, 15.4),
    "LeftToeEnd": ("LeftToeBase", 10.0, 0.4, 22.0),
}  # fmt: skip
"""Parents and places of the joints of SOMA's mean shape in its T-pose, centimetres; the right ones
are mirrored. GEM-X writes rotations alone. (Apache-2.0; github.com/NVlabs/SOMA-X.)"""
JOINT_KEYS = ("pred_joint_coords", "joint_coords", "joints_mhr", "joint_positions", "bone_poses",
              "bone_heads", "joints", "joints_3d", "joints3d")  # fmt: skip
"""Keys of the places of joints, best first."""
POINT_KEYS = ("pred_keypoints_3d", "keypoints_3d")
"""Keys of the places of key points."""
POSE_KEYS = {"poses", "pose", "thetas", "smpl_thetas", "global_orient", "body_pose", "Rh"}
"""Keys of rotations: files with these are read by them, whatever joints they hold."""


@dataclass(frozen=True, eq=False, kw_only=True)
class JointTrack:
    """Places of one person's joints, as a file holds them.

    Attributes:
        body: One of `BODIES`.
        places: Of `POINT_NAMES`, in the file's unit; NaN where unknown.
        frames: Numbers of the frames; None if the file says nothing of them.
        fps: Rows a second, if the file says so.
        turns: World rotations of our joints since SMPL's T-pose, if the file says so.
        lens: As in `build_motion`.
        program: Name of the program that made them, if it is known.
    """

    body: str
    places: Float[np.ndarray, "rows points 3"]
    frames: list[int] | None = None
    fps: float | None = None
    space: PoseSpace = "world"
    turns: Float[np.ndarray, "rows 24 3 3"] | None = None
    lens: Any = None
    program: str | None = None

    def fitted(self, *, upright: bool) -> Motion:
        """Our body's motion, and a note that says how near its joints are; a ValueError if far.

        With `upright`, for a motion of its own, places in the world are turned so that y is up;
        those of a film stay in the world of its cameras.
        """
        rows = rows_with_limbs(self.places)
        places, turns = self.places[rows], None if self.turns is None else self.turns[rows]
        places = places * _unit_m(places)
        if upright and self.space == "world":
            turn = find_upright(places[:, :24])
            places, turns = places @ turn.T, None if turns is None else turn @ turns
        numbers = np.array(self.frames or range(len(self.places)))[rows]
        offsets_m = _offsets_m(self.body)
        found = fit_joints(places, numbers / (self.fps or 30.0), turns, offsets_m)
        known = np.isfinite(found.distances_m).all(axis=0)
        apart = found.distances_m[:, known].mean(axis=0)
        compared = np.array(COMPARED_JOINTS)[known]
        mean, worst = float(apart.mean()), int(apart.argmax())
        name = JOINT_NAMES[compared[worst]].replace("_", " ")
        said = (
            f"{1000.0 * mean:.0f} mm from it on average, the {name} {1000.0 * apart[worst]:.0f} mm"
        )
        if mean > 0.1:
            raise ValueError(
                f"its joints are not {self.body}'s: a person's are {said}. Joints whose names are "
                "not SMPL's, SOMA's or Anny's are known by their number; other skeletons are read "
                "as .bvh or .glb"
            )
        rotations = axis_angles_from_matrices(found.poses.rotations)
        motion = build_motion(
            [rotations.reshape(len(rotations), 72)], found.poses.translations,
            frames=numbers if self.frames or len(rows) < len(self.places) else None,
            times_s=(numbers - numbers[0]) / self.fps if self.fps else None,
            body_model="body24", space=self.space, lens=self.lens,
        )  # fmt: skip
        note = f"The body was fitted to the joints of {self.body}: its joints are {said}."
        program = self.program or f"joints of {self.body}"
        return replace(motion, proportions=found.coefficients, program=program, note=note)


def parse_joints(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """Joints of MHR, SOMA, Anny, SMPL-H or SMPL-X, of one or several people.

    Layouts: SAM 3D Body's outputs (a dictionary a person, in .npz, .json or a pickle, or as lists
    or folders of these, a frame each): {pred_joint_coords (127, 3), pred_keypoints_3d (70, 3),
    pred_keypoints_2d, pred_cam_t (3,), focal_length}, y down, metres, in the camera. GEM-X's
    `hpe_results.pt`: {body_params_incam, body_params_global: {global_orient (L, 3), body_pose (L,
    228), transl (L, 3), scale_params}, K_fullimg}. Anything with joints (N, J, 3) and joint_names,
    or as many joints as a known body has; Anny's {bone_poses (N, J, 4, 4), bone_labels}.
    (github.com/facebookresearch/sam-3d-body, github.com/NVlabs/GEM-X, github.com/naver/anny.)
    """
    track = _read_soma(content, prefer_world)
    if track is not None:
        return {"0": track.fitted(upright=prefer_world)}
    items = list(_find_people(content))
    if not items:
        return None
    fps = content.get("fps") if isinstance(content, dict) else None
    people: dict[str, list[_Item]] = {}
    last: dict[str, Float[np.ndarray, 3]] = {}
    for _, group in groupby(items, key=lambda item: item.frame):
        taken: set[str] = set()
        for item in group:
            place = item.places[0, 1:3].mean(axis=0)  # of the hips
            name = item.person or nearest_person(place, last, taken) or str(len(people))
            taken.add(name)
            last[name] = place
            people.setdefault(name, []).append(item)
    return {name: _join(rows, fps).fitted(upright=prefer_world) for name, rows in people.items()}


def fit_mhr(
    places: Float[np.ndarray, "rows nodes 3"], nodes: Mapping[int, int], fps: float
) -> Motion:
    """Our body's motion by the joints of MHR in the world, in any unit; a ValueError for others'.

    Places are of all nodes of a file; `nodes` holds that of each joint by the joint's number.
    """
    columns = _columns("MHR", None)
    joints = {number: point for point, number in columns.items() if point in JOINT_NAMES}
    missing = [f"{number:03d} ({joints[number]})" for number in joints if number not in nodes]
    if missing:
        raise ValueError(
            f"its joints are numbered, but not as MHR's 127 are: {', '.join(missing)} are missing"
        )
    found = np.full((len(places), len(POINT_NAMES), 3), np.nan)
    for point, number in columns.items():
        if number in nodes:
            found[:, POINT_NAMES.index(point)] = places[:, nodes[number]]
    return JointTrack(body="MHR", places=found, fps=fps, program="SAM 3D Body").fitted(upright=True)


class _Item(NamedTuple):
    """One dictionary of a file: a person in a frame, or in all of them."""

    frame: int
    person: str | None
    body: str
    places: Float[np.ndarray, "rows points 3"]
    in_camera: bool
    intrinsic: Matrix3 | None


def _find_people(node: Any, frame: int | None = None, person: str | None = None) -> Iterator[_Item]:
    """All dictionaries with joints; the outer list or folder holds frames, inner ones people."""
    if isinstance(node, dict):
        numbers = (node[key] for key in ("frame_index", "frame_idx", "frame") if key in node)
        frame = next((int(one) for one in numbers if str(one).isdecimal()), frame)
        person = next((str(node[key]) for key in ("person_id", "track_id") if key in node), person)
        if any(key in node for key in (*JOINT_KEYS, *POINT_KEYS)) and not POSE_KEYS & node.keys():
            yield from filter(None, [_read_item(node, frame or 0, person)])
            return
        parts = {str(key): part for key, part in node.items() if _holds_more(part)}
        if len(parts) == 1:  # such as {"fps": 30, "frames": […]}
            yield from _find_people(next(iter(parts.values())), frame, person)
            return
        numbers = frame_numbers_from_names(parts)
        for number, (key, part) in zip(numbers, parts.items(), strict=True):
            named = (number, person) if frame is None else (frame, key)
            yield from _find_people(part, named[0], named[1])
    elif _holds_more(node):
        for number, part in enumerate(node):
            yield from _find_people(part, number if frame is None else frame, person)


def _holds_more(part: Any) -> bool:
    """Whether it is a dictionary, or a list of them at some depth: no array of numbers."""
    while isinstance(part, list) and part:
        part = part[0]
    return isinstance(part, dict)


def _read_item(node: dict[str, Any], frame: int, person: str | None) -> _Item | None:
    body, places = "", np.full((1, len(POINT_NAMES), 3), np.nan)
    for keys, is_joints in ((POINT_KEYS, False), (JOINT_KEYS, True)):  # joints overwrite key points
        key = next((key for key in keys if key in node), None)
        if key is None or node[key] is None:
            continue
        points = np.asarray(node[key], dtype=np.float64)
        if points.shape[-2:] == (4, 4):
            points = points[..., :3, 3]
        if points.ndim not in (2, 3) or points.shape[-1] != 3 or not points.size:
            raise ValueError(f"`{key}` has the shape {points.shape}; expected (joints, 3)")
        points = points.reshape(-1, *points.shape[-2:])
        names = next(
            (node[some] for some in ("joint_names", "bone_labels") if node.get(some) is not None),
            None,
        )
        body = _known_body(key, points.shape[1], names if is_joints else None)
        columns = _columns(body, list(names) if is_joints and names is not None else None)
        columns = {point: column for point, column in columns.items() if column < points.shape[1]}
        if len(places) < len(points):
            places = np.repeat(places, len(points), axis=0)
        places[:, [POINT_NAMES.index(point) for point in columns]] = points[:, [*columns.values()]]
    if not body:
        return None
    place = next(
        (node[key] for key in ("pred_cam_t", "cam_t", "camera") if node.get(key) is not None), None
    )
    if place is None:
        return _Item(frame, person, body, places, False, None)
    moved = np.asarray(place, dtype=np.float64).reshape(-1, 1, 3)
    return _Item(frame, person, body, places + moved, True, _intrinsic(node, moved))


def _known_body(key: str, count: int, names: Any) -> str:
    """The body by the names of its joints, else by their number."""
    if names is not None:
        counted = {body: len(_columns(body, list(names))) for body in (*BODIES[2:4], NAMED)}
        best = max(counted, key=lambda body: counted[body])
        if counted[best] >= 12:
            return best
    if count == 127 and key in JOINT_KEYS[:4]:
        return "MHR"
    if count not in COUNTS:
        raise ValueError(
            f"`{key}` holds {count} joints; expected the {', '.join(map(str, COUNTS))} of a body "
            f"that is known ({', '.join(BODIES)}), or joint_names with "
            f"{', '.join(JOINT_NAMES[:6])} …"
        )
    return COUNTS[count]


def _columns(body: str, names: list[str] | None) -> dict[str, int]:
    """Where each of our points is among the joints of a body."""
    if body == NAMED:
        plain = [str(name).replace("-", "_").lower() for name in names or ()]
        return {point: plain.index(point) for point in POINT_NAMES if point in plain}
    column, found = BODIES.index(body), {}
    for point, known in MIDDLE_JOINTS.items():
        found[point] = known[column]
    for point, known in SIDE_JOINTS.items():
        of, sides = known[column], ("Left", "Right")
        if isinstance(of, str):
            of = [f"{of}.{side[0]}" if body == "Anny" else side + of for side in sides]
        for side, one in zip(sides, of or (None, None), strict=True):
            found[f"{side.lower()}_{point}"] = one
    order = list(SOMA_JOINTS if names is None else names)
    placed = {
        point: order.index(one) if isinstance(one, str) and one in order else one
        for point, one in found.items()
    }
    return {point: one for point, one in placed.items() if isinstance(one, int)}


def _offsets_m(body: str) -> JointPlaces:
    """Where a body has its joints, from ours in our rest pose, metres."""
    offsets = np.zeros((24, 3))
    for point, place in OFFSETS_CM.get(body, {}).items():
        for side, mirror in (("", 1.0), ("left_", 1.0), ("right_", -1.0)):
            if side + point in JOINT_NAMES:
                offsets[JOINT_NAMES.index(side + point)] = np.array(place) * (mirror, 1.0, 1.0)
    return offsets / 100.0


def _intrinsic(node: dict[str, Any], moved: Float[np.ndarray, "rows 1 3"]) -> Matrix3 | None:
    """The camera that shows the key points in space where those in the image are."""
    if not {"pred_keypoints_3d", "pred_keypoints_2d"} <= node.keys():
        return None
    points = np.asarray(node["pred_keypoints_3d"], dtype=np.float64).reshape(len(moved), -1, 3)
    pixels = np.asarray(node["pred_keypoints_2d"], dtype=np.float64).reshape(-1, 2)
    seen = (points + moved).reshape(-1, 3)
    matrix = np.eye(3)
    for axis in (0, 1):  # u = f x / z + c
        matrix[axis, [axis, 2]] = np.polyfit(seen[:, axis] / seen[:, 2], pixels[:, axis], 1)
    return matrix


def _join(rows: list[_Item], fps: Any) -> JointTrack:
    """The dictionaries of one person."""
    bodies = {row.body for row in rows}
    if len(bodies) > 1:
        raise ValueError(f"it holds joints of several bodies: {', '.join(sorted(bodies))}")
    known = [row.intrinsic for row in rows if row.intrinsic is not None]
    in_camera = rows[0].in_camera
    return JointTrack(
        body=rows[0].body,
        places=np.concatenate([row.places for row in rows]),
        frames=[row.frame for row in rows] if len(rows) > 1 else None,
        fps=None if fps is None else float(fps),
        space="camera" if in_camera else "world",
        lens=(np.median(known, axis=0) if known else DIAGONAL_FOCAL) if in_camera else None,
        program="SAM 3D Body" if rows[0].body.startswith("MHR") else None,
    )


def _read_soma(content: Any, prefer_world: bool) -> JointTrack | None:
    """GEM-X's rotations, on SOMA's mean skeleton in the size that they state."""
    if not isinstance(content, dict):
        return None
    views = [key for key in ("body_params_incam", "body_params_global") if key in content]
    if not views or "body_pose" not in content[views[0]]:
        return None
    view = views[-1] if prefer_world else views[0]
    held, in_camera = content[view], view.endswith("incam")
    root = np.asarray(held["global_orient"], dtype=np.float64).reshape(-1, 1, 3)
    others = np.asarray(held["body_pose"], dtype=np.float64).reshape(len(root), -1, 3)
    if others.shape[1] != len(SOMA_JOINTS) - 1:
        raise ValueError(f"`body_pose` turns {others.shape[1]} joints; SOMA has 76 and its root")
    local = rotation_matrices(np.concatenate([root, others], axis=1))
    size = np.asarray(held.get("scale_params", 1.0), dtype=np.float64).reshape(-1)[0]
    turned, placed = {}, {"": np.asarray(held["transl"], dtype=np.float64).reshape(-1, 3)}
    for name, (parent, rest) in _soma_rest().items():
        turn = local[:, SOMA_JOINTS.index(name)]
        turned[name] = turned[parent] @ turn if parent else turn
        bone = size * (rest - _soma_rest()[parent][1]) if parent else np.zeros(3)
        placed[name] = placed[parent] + (turned[parent] @ bone if parent else 0.0)
    places = np.full((len(root), len(POINT_NAMES), 3), np.nan)
    turns = np.empty((len(root), 24, 3, 3))
    columns = _columns("SOMA", None)
    for point, column in columns.items():
        places[:, POINT_NAMES.index(point)] = placed[SOMA_JOINTS[column]]
    for joint, point in enumerate(JOINT_NAMES):
        name = SOMA_JOINTS[columns[point.replace("hand", "wrist")]]
        turns[:, joint] = turned[name]
    return JointTrack(
        body="SOMA", places=places, turns=turns, space="camera" if in_camera else "world",
        lens=content.get("K_fullimg") if in_camera else None, program="GEM-X",
    )  # fmt: skip


def _soma_rest() -> dict[str, tuple[str, Vector3]]:
    """Parent and place at rest of SOMA's joints on both sides, metres."""
    rest = {}
    for name, (parent, *place) in SOMA_REST_CM.items():
        there = np.array(place) / 100.0
        rest[name] = parent, there
        right = name.replace("Left", "Right")
        if right != name:
            rest[right] = parent.replace("Left", "Right"), there * (-1.0, 1.0, 1.0)
    return rest


def _unit_m(places: Float[np.ndarray, "rows points 3"]) -> float:
    """The unit of places, metres, by the length of the legs."""
    legs = np.diff(places[:, [POINT_NAMES.index(f"left_{n}") for n in ("hip", "knee", "ankle")]],
                   axis=1)  # fmt: skip
    length = float(np.median(np.linalg.norm(legs, axis=-1).sum(axis=1)))
    if not length:
        raise ValueError("hips, knees and ankles lie in one place")
    # the unit that brings the legs nearest to 0.75 m
    return min((1.0, 0.01, 0.001), key=lambda unit: abs(np.log(max(unit * length, 1e-9) / 0.75)))

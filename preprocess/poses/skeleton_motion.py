"""A motion of any humanoid skeleton, retargeted onto SMPL's 24 joints by names and bone directions.

Skeletons differ in names, axes, units, rest poses and the orientation of their joints. Rotations
are therefore carried over as changes since one reference pose, in which both skeletons are brought
together by the directions of their bones: the rest pose, or the pose of the motion that is nearest
to SMPL's (a T).
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from capture.camera import Matrix3
from preprocess.body.body_pose import Motion
from preprocess.body.kinematics import (
    JOINT_NAMES,
    PARENTS,
    JointPlaces,
    axis_angles_from_matrices,
    shortest_turn,
    unit_vectors,
)
from preprocess.body.parametric_body import load_body_model
from preprocess.poses.motion_builder import build_motion

Parents = Int[np.ndarray, "joints"]
"""Parent of each joint; -1 for a root."""

LIMB_NAMES = {
    "hip": ("upleg", "upperleg", "thigh", "hip"),
    "knee": ("leg", "lowerleg", "lowleg", "shin", "calf", "knee"),
    "ankle": ("ankle", "foot"),
    "shoulder": ("arm", "upperarm", "uparm", "shldr", "shoulder"),
    "elbow": ("forearm", "lowerarm", "lowarm", "elbow"),
    "wrist": ("wrist", "hand"),
}
"""Names of joints that are needed on either side, without the side, the usual ones first."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SkeletonMotion:
    """A skeleton and its motion, as a file holds them: in its parent's axes, each after its parent.

    Rotations, and places in the file's unit, are those at rest (`offsets`, `rest_rotations`) and
    those of each pose (`translations`, `rotations`).
    """

    names: Sequence[str]
    parents: Parents
    offsets: Float[np.ndarray, "joints 3"]
    rest_rotations: Float[np.ndarray, "joints 3 3"]
    rotations: Float[np.ndarray, "poses joints 3 3"]
    translations: Float[np.ndarray, "poses joints 3"]
    times_s: Float[np.ndarray, "poses"]

    def places(self) -> Float[np.ndarray, "poses joints 3"]:
        """Places of all joints in the world, in the file's unit."""
        return _forward(self.parents, self.rotations, self.translations)[1]

    def retarget(self) -> Motion:
        """The motion as SMPL's: y up, metres by the length of the legs; a ValueError if unknown."""
        target = load_body_model().joints
        source = match_joints(self.names, self.parents)
        is_smpl = {_plain(name) for name in JOINT_NAMES} <= {_plain(name) for name in self.names}
        turned, places = _forward(self.parents, self.rotations, self.translations)
        finite = np.isfinite(places).all(axis=(1, 2))
        if not (finite.any() and np.ptp(places[finite], axis=1).any()):
            raise ValueError("in no frame are its joints in different, finite places")
        # the rest pose comes last; SMPL's own is the T in which no joint is turned
        at_rest = np.broadcast_to(np.eye(3), (len(self.names), 3, 3))
        at_rest = at_rest if is_smpl else self.rest_rotations
        rest_turned, rest_places = _forward(self.parents, at_rest[None], self.offsets[None])
        turned = np.concatenate([turned, rest_turned])
        places = np.concatenate([places, rest_places])
        columns = [-1 if column is None else column for column in source.values()]
        up = find_upright(places[:-1, columns])
        turned, places = up @ turned, places @ up.T
        points = places[:, columns]
        _check_limbs(points[-1])
        if is_smpl:
            reference, matched = len(turned) - 1, np.broadcast_to(np.eye(3), (24, 3, 3))
        else:
            reference = _nearest_to_rest(points, target)
            matched = _match_rest(points[reference], target, columns)
        changes = turned @ turned[reference].swapaxes(-1, -2)
        world = np.empty((len(turned) - 1, 24, 3, 3))
        for joint, parent in enumerate(PARENTS):
            column = columns[joint]
            if column < 0:
                local = matched[parent].T @ matched[joint]
                world[:, joint] = world[:, parent] @ local
            else:
                world[:, joint] = changes[:-1, column] @ matched[joint]
        local = world.copy()
        local[:, 1:] = world[:, PARENTS[1:]].swapaxes(-1, -2) @ world[:, 1:]
        legs = _leg_length(points[-1])
        in_metres = is_smpl and 0.5 < legs < 1.2  # a person's legs, in metres
        scale = 1.0 if in_metres else _leg_length(target) / legs
        return build_motion(
            [axis_angles_from_matrices(local)],
            scale * points[:-1, 0] - target[0],
            times_s=self.times_s,
            space="world",
        )


def match_joints(names: Sequence[str], parents: Parents) -> dict[str, int | None]:
    """The joint of a skeleton for each of SMPL's, in order; None where one may be missing."""
    plain = [_plain(name) for name in names]

    def find(candidates: Sequence[str], taken: Sequence[int | None] = ()) -> int | None:
        numbers = (plain.index(name) for name in candidates if name in plain)
        return next((number for number in numbers if number not in taken), None)

    matched: dict[str, int | None] = dict.fromkeys(JOINT_NAMES)
    matched["pelvis"] = find(("hips", "pelvis", "hip", "root"))
    matched["head"] = find(("head", "chead", "neck1", "neck"))
    for side in ("left", "right"):
        for joint, known in LIMB_NAMES.items():
            matched[f"{side}_{joint}"] = find([side + name for name in known])
        taken = [matched[f"{side}_{joint}"] for joint in LIMB_NAMES]
        for joint, known in (  # these may be missing
            ("foot", ("toebase", "toe", "toes", "ball", "foot")),
            ("collar", ("collar", "clavicle", "shoulder")),
            ("hand", ("hand",)),
        ):
            matched[f"{side}_{joint}"] = find([side + name for name in known], taken)
    needed = ["pelvis", "head", *(f"{s}_{j}" for s in ("left", "right") for j in LIMB_NAMES)]
    missing = [name for name in needed if matched[name] is None]
    if missing:
        raise ValueError(
            f"no joint is known as {', '.join(missing)} of a person; the joints are called "
            f"{', '.join(list(names)[:30])}"
        )
    _match_axis(matched, parents)
    return matched


def _match_axis(matched: dict[str, int | None], parents: Parents) -> None:
    """Give SMPL's three spine joints and its neck the joints between pelvis, chest and head."""
    arm, head = _chain(matched["left_shoulder"], parents), _chain(matched["head"], parents)
    chest = next((joint for joint in head if joint in arm), None)  # the nearest one to both
    if chest is None:
        raise ValueError("its head and its arms hang on different roots")
    torso = [joint for joint in _chain(chest, parents)[::-1] if joint not in
             _chain(matched["pelvis"], parents)]  # fmt: skip
    if torso:
        for name, place in zip(("spine1", "spine2", "spine3"), (0.0, 0.5, 1.0), strict=True):
            matched[name] = torso[round(place * (len(torso) - 1))]
    between = head[1 : head.index(chest)]
    matched["neck"] = between[-1] if between else None


def _chain(joint: int | None, parents: Parents) -> list[int]:
    """A joint and its ancestors, up to the root."""
    chain: list[int] = []
    while joint is not None and joint >= 0:
        chain.append(joint)
        joint = int(parents[joint])
    return chain


def _plain(name: str) -> str:
    """A joint's name in small letters, without name space, with the side first and whole."""
    plain = re.sub(r"[^a-z0-9]", "", name.rsplit(":", 1)[-1].lower())
    plain = re.sub(r"^(mixamorig\d*|bip0?1|jbip[clr]|jbip)", "", plain)
    marked = re.fullmatch(r"(?:.*[._\- ])?([lr])[._\- ](\w+)", name, re.IGNORECASE)
    trailing = re.fullmatch(r"(\w+?)[._\- ]([lr])", name, re.IGNORECASE)
    if marked:
        side, rest = marked[1], marked[2]
    elif trailing:
        rest, side = trailing[1], trailing[2]
    elif re.fullmatch(r"[lr][A-Z]\w+", name):  # lShldr, rThigh
        side, rest = name[0], name[1:]
    else:
        return plain
    side = "left" if side.lower() == "l" else "right"
    return side + re.sub(r"[^a-z0-9]", "", rest.lower())


def _forward(
    parents: Parents,
    rotations: Float[np.ndarray, "poses joints 3 3"],
    translations: Float[np.ndarray, "poses joints 3"],
) -> tuple[Float[np.ndarray, "poses joints 3 3"], Float[np.ndarray, "poses joints 3"]]:
    """Rotations and places of all joints in the world."""
    turned, places = rotations.copy(), translations.copy()
    for joint, parent in enumerate(parents.tolist()):
        if parent >= 0:
            turned[:, joint] = turned[:, parent] @ rotations[:, joint]
            moved = np.einsum("nab,nb->na", turned[:, parent], translations[:, joint])
            places[:, joint] = places[:, parent] + moved
    return turned, places


def find_upright(points: Float[np.ndarray, "poses 24 3"]) -> Matrix3:
    """The rotation that turns the axis from feet to shoulders to y, by the median over a motion."""
    feet, shoulders = (
        points[:, [JOINT_NAMES.index(f"{side}_{joint}") for side in ("left", "right")]].mean(axis=1)
        for joint in ("ankle", "shoulder")
    )
    height = np.nanmedian(shoulders - feet, axis=0)
    axis = int(np.abs(height).argmax())
    up = np.sign(height[axis]) * np.eye(3)[axis]
    return shortest_turn(up, np.array([0.0, 1.0, 0.0]))


def _leg_length(points: JointPlaces) -> float:
    joints = [JOINT_NAMES.index(f"left_{name}") for name in ("hip", "knee", "ankle")]
    return float(np.linalg.norm(np.diff(points[joints], axis=0), axis=1).sum())


def _check_limbs(points: JointPlaces) -> None:
    """Refuse bones of lengths that no person has: a program may give joints others' names."""
    start, end = np.array(LIMBS).T
    lengths = np.linalg.norm(points[end] - points[start], axis=-1).reshape(2, 2, 2)
    lengths = np.maximum(lengths, 1e-9)
    sides = np.abs(np.log(lengths[0] / lengths[1]))
    halves = np.abs(np.log(lengths[..., 0] / lengths[..., 1]))
    if not (sides.max() < np.log(1.5) and halves.max() < np.log(3.0)):
        said = ", ".join(
            f"{side} {limb} {length / lengths.max():.2f}"
            for side, legs_and_arms in zip(("left", "right"), lengths, strict=True)
            for limb, length in zip(
                ("thigh", "shin", "upper arm", "forearm"), legs_and_arms.ravel(), strict=True
            )
        )
        raise ValueError(
            f"its bones are not those of a person, whatever they are called ({said} of the "
            "longest): the program that wrote it has taken other joints for them"
        )


def _frames(points: Float[np.ndarray, "poses 24 3"]) -> Float[np.ndarray, "poses 3 3"]:
    """Axes of the trunk: from the right hip to the left one, up to the shoulders, forward."""
    left, right = (
        points[:, JOINT_NAMES.index("left_hip")],
        points[:, JOINT_NAMES.index("right_hip")],
    )
    shoulders = [JOINT_NAMES.index("left_shoulder"), JOINT_NAMES.index("right_shoulder")]
    x = unit_vectors(left - right)
    z = unit_vectors(np.cross(x, points[:, shoulders].mean(axis=1) - 0.5 * (left + right)))
    return np.stack([x, np.cross(z, x), z], axis=-1)


LIMBS = tuple(
    (JOINT_NAMES.index(f"{side}_{joint}"), JOINT_NAMES.index(f"{side}_{child}"))
    for side in ("left", "right")
    for joint, child in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"),
                         ("elbow", "wrist"))
)  # fmt: skip
"""Bones of the limbs: a joint and its child."""


def _nearest_to_rest(points: Float[np.ndarray, "poses 24 3"], target: JointPlaces) -> int:
    """The pose whose limbs have most nearly the directions of SMPL's at rest."""
    rows = np.unique(np.linspace(0, len(points) - 1, 200).round().astype(int))
    start, end = np.array(LIMBS).T
    bones = unit_vectors(points[rows][:, end] - points[rows][:, start])
    trunk = np.einsum("nab,nka->nkb", _frames(points[rows]), bones)
    wanted = unit_vectors(target[end] - target[start]) @ _frames(target[None])[0]
    angles = np.arccos(np.clip((trunk * wanted).sum(axis=-1), -1.0, 1.0)).mean(axis=1)
    return int(rows[np.nanargmin(angles)])


def _match_rest(
    points: JointPlaces, target: JointPlaces, columns: Sequence[int]
) -> Float[np.ndarray, "24 3 3"]:
    """SMPL's joint rotations, in the world, that bring its limbs onto those of a reference pose.

    The trunk is upright as SMPL's is; each limb takes the shortest turn from its parent's, a foot
    about the vertical alone.
    """
    trunk = _frames(points[None])[0] @ _frames(target[None])[0].T
    world = np.broadcast_to(trunk, (24, 3, 3)).copy()
    ends = dict(LIMBS)
    for joint, parent in enumerate(PARENTS):
        if joint in ends:
            start = world[parent] if parent in ends else trunk
            bone = start @ (target[ends[joint]] - target[joint])
            world[joint] = shortest_turn(bone, points[ends[joint]] - points[joint]) @ start
        elif parent in ends and "wrist" in JOINT_NAMES[joint]:
            world[joint] = world[parent]
        elif parent in ends and "ankle" in JOINT_NAMES[joint]:
            toe = joint + 3
            if columns[toe] >= 0:
                flat = np.array([1.0, 0.0, 1.0])
                now, wanted = trunk @ (target[toe] - target[joint]), points[toe] - points[joint]
                world[joint] = shortest_turn(flat * now, flat * wanted) @ trunk
        elif parent > 0 and JOINT_NAMES[parent].endswith(("ankle", "wrist")):
            world[joint] = world[parent]
    return world

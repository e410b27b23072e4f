"""A parametric body in three stages: the model, a shape of it, and a pose of that shape.

Models are read from SMPL's keys (.npz or .pkl); the resting body of an avatar is written and read.
"""

import json
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, Int, Shaped

from capture.camera import Transform
from capture.input_error import InputError
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.kinematics import (
    PARENTS,
    JointPlaces,
    body_from_rest,
    rotation_matrices,
    world_from_body,
)
from preprocess.file_content import explain_damage, read_npz, read_pickled_arrays


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyModel:
    """A 24-joint body with linear blend skinning (SMPL's tree; Loper et al. 2015).

    Attributes:
        family: Family of betas that fit: "smpl" or "body24".
        template: Rest vertices of the mean shape, metres, T-pose.
        weights: Skinning weights, rows sum to 1.
        joints: Rest joints of the mean shape, metres.
        parents: Parent of each joint, -1 for the root.
        shape_directions, joint_directions: Displacement per unit of beta, metres.
        pose_directions: Pose blend shapes, or None where the file has none.
    """

    family: str
    template: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    weights: Float[np.ndarray, "vertices 24"]
    joints: JointPlaces
    parents: Int[np.ndarray, "24"]
    shape_directions: Float[np.ndarray, "vertices 3 betas"]
    joint_directions: Float[np.ndarray, "24 3 betas"]
    pose_directions: Float[np.ndarray, "vertices 3 207"] | None = None

    def with_shape(self, betas: Float[np.ndarray, "betas"] | None = None) -> "ShapedBody":
        """The body of one person; the mean shape if `betas` is None (missing betas count as 0)."""
        vertices, joints = self.template, self.joints
        if betas is not None:
            count = min(len(betas), self.shape_directions.shape[-1])
            vertices = vertices + self.shape_directions[..., :count] @ betas[:count]
            joints = joints + self.joint_directions[..., :count] @ betas[:count]
        return ShapedBody(body=self, vertices=vertices, joints=joints)


@dataclass(frozen=True, eq=False, kw_only=True)
class ShapedBody:
    """One person's body at rest: vertices and joints in metres.

    `joints[0]` is the pelvis J0 that the root turns about.
    """

    body: BodyModel
    vertices: Float[np.ndarray, "vertices 3"]
    joints: JointPlaces

    @property
    def height_m(self) -> float:
        """Height from the soles to the crown at rest, metres: barefoot, without hair."""
        return float(np.ptp(self.vertices[:, 1]))

    def scaled_to(self, height_m: float) -> "ShapedBody":
        """This person with another height; proportions stay."""
        factor, body = height_m / self.height_m, self.body
        directions = body.pose_directions
        if directions is not None:
            body = replace(body, pose_directions=factor * directions)
        return ShapedBody(body=body, vertices=factor * self.vertices, joints=factor * self.joints)

    def is_same_person(self, other: "ShapedBody") -> bool:
        """Check whether two shapes of one body model are the same person."""
        pairs = ((self.vertices, other.vertices), (self.joints, other.joints))
        return self.vertices.shape == other.vertices.shape and all(
            bool(np.abs(one - another).max() < 5e-4)
            for one, another in pairs  # metres
        )

    def with_pose(self, pose: BodyPose) -> "PosedBody":
        """This person in one pose."""
        return PosedBody(shaped=self, pose=pose)


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedBody:
    """One person in one pose."""

    shaped: ShapedBody
    pose: BodyPose

    def body_from_rest(self) -> Float[np.ndarray, "24 4 4"]:
        """Joint transforms with the root left at rest."""
        shaped = self.shaped
        return body_from_rest(shaped.joints, shaped.body.parents, self.pose.joint_rotations)

    def world_from_body(self) -> Transform:
        """The root's rigid motion."""
        pose = self.pose
        return world_from_body(self.shaped.joints[0], pose.root_rotation, pose.root_translation)

    def world_from_rest(self) -> Float[np.ndarray, "24 4 4"]:
        """Joint transforms into the world (SMPL's A, translation included)."""
        return self.world_from_body() @ self.body_from_rest()

    def vertices(self) -> Float[np.ndarray, "vertices 3"]:
        """Posed vertices in the world, metres, with pose blend shapes where the model has them."""
        body, rest = self.shaped.body, self.shaped.vertices
        if body.pose_directions is not None:
            rotations = rotation_matrices(self.pose.joint_rotations)
            rest = rest + body.pose_directions @ (rotations - np.eye(3)).ravel()
        world_from_rest = np.einsum("vj,jab->vab", body.weights, self.world_from_rest())
        return np.einsum("vab,vb->va", world_from_rest[:, :3, :3], rest) + world_from_rest[:, :3, 3]

    def joints(self) -> JointPlaces:
        """Posed joints in the world, metres."""
        transforms, rest = self.world_from_rest(), self.shaped.joints
        return np.einsum("jab,jb->ja", transforms[:, :3, :3], rest) + transforms[:, :3, 3]


def betas_for_motion(body: BodyModel, motion: Motion) -> Float[np.ndarray, "betas"]:
    """The motion's betas if they were made for this family of bodies, else zeros.

    Betas are coordinates in one model's shape space and mean nothing in another's.
    """
    if motion.body_model == body.family:
        return motion.betas
    return np.zeros(body.shape_directions.shape[-1])


def with_smpl_joints(shaped: ShapedBody) -> ShapedBody:
    """The body with its joints where SMPL's mean shape has them, its pelvis where it was.

    The limbs rest in the same directions (see data/LICENSE-body24.md): what changes is mostly how
    long they are.
    """
    joints = smpl_rest_joints() - smpl_rest_joints()[0] + shaped.joints[0]
    moved = shaped.body.weights @ (joints - shaped.joints)
    return ShapedBody(body=shaped.body, vertices=shaped.vertices + moved, joints=joints)


@cache
def smpl_rest_joints() -> JointPlaces:
    """Rest joints of SMPL's mean shape, metres (public; see data/LICENSE-body24.md)."""
    text = (files("preprocess") / "data" / "smpl_rest_joints.json").read_text(encoding="utf-8")
    return np.array(json.loads(text)["neutral"], dtype=np.float64)


REQUIRED_BODY_KEYS = ("v_template", "shapedirs", "weights", "kintree_table", "f")
"""Keys of SMPL's body files that must exist."""
BODY_KEYS = (*REQUIRED_BODY_KEYS, "J_regressor", "J", "J_shapedirs", "posedirs")
"""All keys of body files that are read."""
Arrays = dict[str, Shaped[np.ndarray, "..."]]


def load_body_model(path: Path | None = None) -> BodyModel:
    """Read a 24-joint body, SMPL's or ours; the embedded body if no path is given.

    Keys: v_template (V, 3), shapedirs (V, 3, B), weights (V, 24), kintree_table (2, 24), f (F, 3),
    and either J_regressor (24, V), which makes it SMPL's, or J (24, 3) and J_shapedirs (24, 3, B);
    posedirs (V, 3, 207) if there are any. A .pkl is read without executing it.
    """
    path = path or Path(str(files("preprocess") / "data" / "body24.npz"))
    if not path.is_file():
        what = "is no file" if path.exists() else "does not exist"
        raise InputError(
            f"{path} {what}; a body file was expected. Leave --body out for the embedded body."
        )
    if path.suffix.lower() == ".npz":
        arrays = read_npz(path, BODY_KEYS)
    elif path.suffix.lower() == ".pkl":
        arrays = read_pickled_arrays(path, BODY_KEYS)
    else:
        raise InputError(f"{path} ends in {path.suffix!r}; a body file ends in .npz or .pkl.")
    with explain_damage(path, "a body file"):
        return _parse_body(arrays)


def _parse_body(arrays: Arrays) -> BodyModel:
    missing = [key for key in REQUIRED_BODY_KEYS if key not in arrays]
    if missing or not ("J_regressor" in arrays or {"J", "J_shapedirs"} <= arrays.keys()):
        raise ValueError(
            f"it lacks {', '.join(missing) or 'J_regressor'}. "
            f"Expected {', '.join(REQUIRED_BODY_KEYS)} and J_regressor (or J with J_shapedirs)."
        )
    template = _read_array(arrays, "v_template", (-1, 3))
    directions = _read_array(arrays, "shapedirs", (len(template), 3, -1))
    weights = _read_array(arrays, "weights", (len(template), -1))
    if weights.shape[1] != len(PARENTS):
        raise ValueError(
            f"it has {weights.shape[1]} joints; a body of SMPL's {len(PARENTS)} joints was "
            "expected (not SMPL+H or SMPL-X)."
        )
    if "J_regressor" in arrays:
        regressor = _read_array(arrays, "J_regressor", (24, len(template)))
        joints = regressor @ template
        joint_directions = np.einsum("jv,vab->jab", regressor, directions)
    else:
        joints = _read_array(arrays, "J", (24, 3))
        joint_directions = _read_array(arrays, "J_shapedirs", (24, 3, directions.shape[2]))
    return BodyModel(
        family="smpl" if "J_regressor" in arrays else "body24",
        template=template,
        faces=_faces(arrays, len(template)),
        weights=_normalize_weights(weights),
        joints=joints,
        parents=_parents(arrays),
        shape_directions=directions,
        joint_directions=joint_directions,
        pose_directions=_read_array(arrays, "posedirs", (len(template), 3, 207))
        if "posedirs" in arrays
        else None,
    )


def _read_array(arrays: Arrays, key: str, shape: tuple[int, ...]) -> Float64[np.ndarray, "..."]:
    """One array as float64, of the shape given (-1: any length)."""
    array = arrays[key]
    if array.dtype.kind not in "biuf":
        raise ValueError(f"`{key}` holds no numbers.")
    fits = array.ndim == len(shape) and all(
        wanted in (-1, length) for wanted, length in zip(shape, array.shape, strict=False)
    )
    if not fits:
        expected = " x ".join("any" if n < 0 else str(n) for n in shape)
        raise ValueError(f"`{key}` has the shape {array.shape}; expected {expected}.")
    if not np.isfinite(array).all():
        raise ValueError(f"`{key}` holds NaN or infinite numbers; the file is damaged.")
    return np.ascontiguousarray(array, dtype=np.float64)


def _parents(arrays: Arrays) -> Int[np.ndarray, "24"]:
    """Parents as integers; the root's, 2³² - 1 in unsigned files, becomes -1."""
    parents = _read_array(arrays, "kintree_table", (2, 24))[0].astype(np.int64)
    parents = np.where(parents == 2**32 - 1, -1, parents)
    if tuple(parents) != PARENTS:
        raise ValueError(
            f"the joints form another tree than SMPL's: their parents are "
            f"{parents.tolist()}, expected {list(PARENTS)}."
        )
    return parents


def _faces(arrays: Arrays, vertices: int) -> Int[np.ndarray, "faces 3"]:
    faces = _read_array(arrays, "f", (-1, 3)).astype(np.int64)
    if faces.size and not 0 <= faces.min() <= faces.max() < vertices:
        raise ValueError("`f` names vertices that the body does not have.")
    return faces


def _normalize_weights(
    weights: Float[np.ndarray, "vertices 24"],
) -> Float[np.ndarray, "vertices 24"]:
    """Weights whose rows sum to 1 exactly."""
    sums = weights.sum(axis=1, keepdims=True)
    if weights.min() < 0.0 or np.abs(sums - 1.0).max() > 0.02:
        raise ValueError("`weights` are no skinning weights: rows must sum to 1.")
    return weights / sums


SHAPED_BODY_KEYS = ("family", "vertices", "joints")
"""Keys of a file that holds an avatar's person."""


def write_shaped_body(path: Path, person: ShapedBody) -> None:
    """Write the resting vertices and joints, and whose betas would shape the body."""
    np.savez(
        path,
        family=np.array(person.body.family),
        vertices=person.vertices.astype(np.float32),
        joints=person.joints,
    )


def read_shaped_body(path: Path, body: BodyModel) -> ShapedBody:
    """Read the person that `write_shaped_body` wrote, on the same body."""
    arrays = read_npz(path)
    if not set(SHAPED_BODY_KEYS) <= arrays.keys() or arrays["joints"].shape != (24, 3):
        raise InputError(
            f"{path} holds no person; expected {', '.join(SHAPED_BODY_KEYS)}. Is it ours?"
        )
    family, vertices = str(arrays["family"]), arrays["vertices"].astype(np.float64)
    if family != body.family or vertices.shape != body.template.shape:
        raise InputError(
            f"{path}: the avatar was learnt on a {family!r} body of {len(vertices)} vertices, "
            f"now it is {body.family!r} with {len(body.template)}. Give the same --body as then "
            "(none is the embedded body), or train the avatar from the start (--overwrite)."
        )
    return ShapedBody(body=body, vertices=vertices, joints=arrays["joints"].astype(np.float64))

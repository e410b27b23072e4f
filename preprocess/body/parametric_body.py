"""A parametric body in three stages: the model, a shape of it, and a pose of that shape."""

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
from jaxtyping import Float, Int

from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.kinematics import body_from_rest, rotation_matrices, world_from_body


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyModel:
    """A 24-joint body with linear blend skinning (SMPL's tree; Loper et al. 2015).

    Attributes:
        family: Whose betas fit: "smpl" or "body24".
        template: Rest vertices of the mean shape, metres, T-pose.
        faces: Triangles.
        weights: Skinning weights, rows sum to 1.
        joints: Rest joints of the mean shape, metres.
        parents: Parent of each joint, -1 for the root.
        shape_directions: Vertex displacement per unit of beta, metres.
        joint_directions: Joint displacement per unit of beta, metres.
        pose_directions: Pose blend shapes (vertices, 3, 207), or None where the file has none.
    """

    family: str
    template: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    weights: Float[np.ndarray, "vertices 24"]
    joints: Float[np.ndarray, "24 3"]
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
    """One person's body at rest.

    Attributes:
        body: The model.
        vertices: Rest vertices, metres.
        joints: Rest joints, metres; `joints[0]` is the pelvis J0 that the root turns about.
    """

    body: BodyModel
    vertices: Float[np.ndarray, "vertices 3"]
    joints: Float[np.ndarray, "24 3"]

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

    def world_from_body(self) -> Float[np.ndarray, "4 4"]:
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

    def joints(self) -> Float[np.ndarray, "24 3"]:
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
def smpl_rest_joints() -> Float[np.ndarray, "24 3"]:
    """Rest joints of SMPL's mean shape, metres (public; see data/LICENSE-body24.md)."""
    text = (files("preprocess") / "data" / "smpl_rest_joints.json").read_text(encoding="utf-8")
    return np.array(json.loads(text)["neutral"], dtype=np.float64)

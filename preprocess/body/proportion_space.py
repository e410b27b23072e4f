"""Proportions of a person: a linear space of shapes around a shaped body.

The directions are the body model's own shape coefficients, the lengths of bones, and the girths of
body parts. Girths also take up the thickness of clothes and hair, which no body model has. The
person of a motion has the proportions, or the betas, that its poses were made for.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from capture.input_error import InputError
from preprocess.body.body_pose import Motion
from preprocess.body.body_surface import smooth_over_surface, vertex_normals
from preprocess.body.kinematics import HEAD_JOINT, JointPlaces
from preprocess.body.parametric_body import (
    BodyModel,
    ShapedBody,
    betas_for_motion,
    with_smpl_joints,
)

BONE_GROUPS = {
    "hip width": (1, 2), "thigh": (4, 5), "shin": (7, 8), "foot": (10, 11), "trunk": (3, 6, 9),
    "neck": (12, 15), "shoulder width": (13, 14, 16, 17), "upper arm": (18, 19),
    "forearm": (20, 21),
}  # fmt: skip
"""Joints whose distance from their parent one length changes, on both sides alike."""
GIRTH_GROUPS = {
    "hips": (0, 3), "chest": (6, 9, 13, 14), "thighs": (1, 2), "calves": (4, 5),
    "feet": (7, 8, 10, 11), "upper arms": (16, 17), "forearms": (18, 19),
    "hands": (20, 21, 22, 23), "head": (12, 15),
}  # fmt: skip
"""Joints whose skin one girth moves outward; that of the head moves the skin under hair alone."""
SIGMA_BETA = 0.7
"""Prior standard deviation of a shape coefficient."""
SIGMA_LOG_LENGTH = 0.05
"""Prior standard deviation of the logarithm of a bone's length."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ProportionSpace:
    """A linear space of shapes; coefficients are in units of their prior's standard deviation.

    Attributes:
        shaped: The shape at which all coefficients are 0.
        vertex_directions, joint_directions: Displacement at rest per coefficient, metres.
    """

    shaped: ShapedBody
    vertex_directions: Float[np.ndarray, "vertices 3 coefficients"]
    joint_directions: Float[np.ndarray, "24 3 coefficients"]

    @classmethod
    def around(cls, shaped: ShapedBody) -> "ProportionSpace":
        """The space around one person's shape."""
        body = shaped.body
        outward = _outward_directions(shaped)
        lengths = [_lengthen(shaped, joints) for joints in BONE_GROUPS.values()]
        girths = [
            0.02 * body.weights[:, list(joints)].sum(axis=1)[:, None] * outward
            for joints in GIRTH_GROUPS.values()
        ]
        still = np.zeros((24, 3))
        vertices = [SIGMA_LOG_LENGTH * moved for moved, _ in lengths] + girths
        joints = [SIGMA_LOG_LENGTH * moved for _, moved in lengths] + [still] * len(girths)
        return cls(
            shaped=shaped,
            vertex_directions=np.concatenate(
                [SIGMA_BETA * body.shape_directions, np.stack(vertices, axis=-1)], axis=-1
            ),
            joint_directions=np.concatenate(
                [SIGMA_BETA * body.joint_directions, np.stack(joints, axis=-1)], axis=-1
            ),
        )

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return self.joint_directions.shape[-1]

    def shape(self, coefficients: Float[np.ndarray, "coefficients"]) -> ShapedBody:
        """The body with these proportions."""
        return ShapedBody(
            body=self.shaped.body,
            vertices=self.shaped.vertices + self.vertex_directions @ coefficients,
            joints=self.shaped.joints + self.joint_directions @ coefficients,
        )


def _outward_directions(shaped: ShapedBody) -> Float[np.ndarray, "vertices 3"]:
    """Directions in which clothes and hair thicken the body; shorter on fingers, zero on a face."""
    body, vertices = shaped.body, shaped.vertices
    normals = vertex_normals(vertices, body.faces)
    low, top = shaped.joints[HEAD_JOINT, 1], vertices[:, 1].max()
    # normals that point forward, below the hairline; ears may lie under hair
    is_face = (normals[:, 2] > 0.2) & (vertices[:, 1] < low + 0.7 * (top - low))
    face = is_face * body.weights[:, HEAD_JOINT]
    both = np.column_stack([normals, face])
    # along vertices' own normals, hair and loose clothes would inflate noses, ears and fingers
    *outward, bare = smooth_over_surface(vertices, body.faces, both, sigma_m=0.02).T
    return np.column_stack(outward) * (1.0 - bare[:, None])


def _lengthen(
    shaped: ShapedBody, group: tuple[int, ...]
) -> tuple[Float[np.ndarray, "vertices 3"], JointPlaces]:
    """Displacement of vertices and joints per unit of log length of the bones that end in a group.

    A vertex moves with its bone's joint and, in proportion to its place along the bone, with the
    joint at the bone's end.
    """
    joints, parents = shaped.joints, shaped.body.parents
    moved = np.zeros((24, 3))
    for joint in range(1, 24):
        parent = int(parents[joint])
        moved[joint] = moved[parent]
        if joint in group:
            moved[joint] += joints[joint] - joints[parent]
    vertices = np.zeros_like(shaped.vertices)
    for bone in range(24):
        weight = shaped.body.weights[:, bone : bone + 1]
        children = [joint for joint in group if parents[joint] == bone]
        vertices += weight * moved[bone]
        if len(children) == 1:
            along = joints[children[0]] - joints[bone]
            place = (shaped.vertices - joints[bone]) @ along / (along @ along)
            vertices += (
                weight * np.clip(place, 0.0, 1.0)[:, None] * (moved[children[0]] - moved[bone])
            )
    return vertices, moved


def shape_for_motion(body: BodyModel, motion: Motion) -> ShapedBody:
    """The person that a motion's tracker had in mind, as nearly as the body allows.

    A body that is not SMPL's takes the rest joints of SMPL's mean shape if the poses are SMPL's:
    then its joints move exactly as SMPL's do. Its skin goes along, each vertex with its joints.
    Proportions of another number than the body's are an InputError.
    """
    if motion.proportions is not None and motion.body_model == body.family:
        space = ProportionSpace.around(body.with_shape())
        if len(motion.proportions) != space.count:
            raise InputError(
                f"The poses hold {len(motion.proportions)} proportions, the body has "
                f"{space.count}; they were made for another version of the body."
            )
        return space.shape(motion.proportions)
    shaped = body.with_shape(betas_for_motion(body, motion))
    is_own = body.family == "smpl" or motion.body_model == body.family
    return shaped if is_own else with_smpl_joints(shaped)

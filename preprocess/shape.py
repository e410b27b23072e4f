"""Which shape a motion gives a body."""

import json
from functools import cache
from importlib.resources import files

import numpy as np
from jaxtyping import Float

from preprocess.body import BodyModel, ShapedBody
from preprocess.pose import Motion


def shape_for_motion(body: BodyModel, motion: Motion) -> ShapedBody:
    """The person that a motion's tracker had in mind, as nearly as the body allows.

    A body that is not SMPL's takes the rest joints of SMPL's mean shape if the poses are SMPL's:
    then its joints move exactly as SMPL's do. Its skin goes along, each vertex with its joints.
    """
    shaped = body.with_shape(betas_for_motion(body, motion))
    return shaped if body.family == "smpl" or motion.body_model == body.family else with_smpl_joints(shaped)


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

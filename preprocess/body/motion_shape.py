"""The person whose poses a motion holds."""

from capture.input_error import InputError
from preprocess.body.body_pose import Motion
from preprocess.body.parametric_body import (
    BodyModel,
    ShapedBody,
    betas_for_motion,
    with_smpl_joints,
)
from preprocess.body.proportion_space import ProportionSpace


def shape_for_motion(body: BodyModel, motion: Motion) -> ShapedBody:
    """The person that a motion's tracker had in mind, as nearly as the body allows.

    A body that is not SMPL's takes the rest joints of SMPL's mean shape if the poses are SMPL's:
    then its joints move exactly as SMPL's do. Its skin goes along, each vertex with its joints.

    Raises:
        InputError: If the motion's proportions are of another number than the body's.
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
    return (
        shaped
        if body.family == "smpl" or motion.body_model == body.family
        else with_smpl_joints(shaped)
    )

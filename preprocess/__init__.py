"""Preprocess: what is known about each frame, as a mask, a body pose and a camera."""

from preprocess.body.body_pose import BodyPose as BodyPose
from preprocess.body.body_pose import Motion as Motion
from preprocess.body.parametric_body import BodyModel as BodyModel
from preprocess.body.parametric_body import PosedBody as PosedBody
from preprocess.body.parametric_body import ShapedBody as ShapedBody
from preprocess.observation import Observation as Observation

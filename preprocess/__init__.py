"""Preprocess: what is known about each frame, as a mask, a body pose and a camera."""

from preprocess.body import BodyModel as BodyModel
from preprocess.body import PosedBody as PosedBody
from preprocess.body import ShapedBody as ShapedBody
from preprocess.observation import Observation as Observation
from preprocess.pose import BodyPose as BodyPose
from preprocess.pose import Motion as Motion

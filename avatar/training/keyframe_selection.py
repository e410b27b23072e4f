"""Similarity of frames as training views, and the selection of keyframes from a video."""

from typing import final

import numpy as np
from jaxtyping import Float, Shaped

from avatar.config import TrainConfig
from avatar.deformation.rig import Rig
from preprocess.body.body_pose import BodyPose
from preprocess.observation import Observation

JOINT_ANGLE_WEIGHT = 0.5
"""Weight of a radian of joint rotation relative to a radian of view direction."""
MIN_KEYFRAME_DISTANCE = 0.05
"""Descriptor distance below which two frames show the same view, about 3°."""
INITIAL_KEYFRAMES = TrainConfig.replay_capacity
"""Number of frames that are accepted whatever they show: the default replay capacity."""
MAX_KEYFRAME_INTERVAL_S = 0.5
"""Longest time between keyframes of a person who stands still, seconds."""


def view_descriptor(origin: Shaped[np.ndarray, "3"], pose: BodyPose) -> Float[np.ndarray, " 72"]:
    """Descriptor of a view; the distance between two descriptors resembles an angle, radians.

    Args:
        origin: Camera center in the body frame, metres.
        pose: Pose of the body.

    Returns:
        View direction and weighted joint rotations.
    """
    facing = origin / np.linalg.norm(origin)
    return np.concatenate([facing, pose.joint_rotations.ravel() * JOINT_ANGLE_WEIGHT])


@final
class KeyframeSelector:
    """Chooses the frames of a long stream that show something new.

    At 30 frames a second most look like the one before: to make each ready would cost more than
    it teaches, and take the time from training.
    """

    def __init__(self, rig: Rig, *, initial_keyframes: int = INITIAL_KEYFRAMES) -> None:
        """Starts without keyframes; the first `initial_keyframes` frames are all accepted."""
        self._rig, self._initial_left = rig, initial_keyframes
        self._last: tuple[float, Float[np.ndarray, " 72"]] | None = None

    def accepts(self, observation: Observation) -> bool:
        """Whether a frame is worth learning from, after those that were taken before."""
        world_from_body = self._rig.world_from_body(observation.pose)
        away = observation.camera.center_world - world_from_body[:3, 3]
        now = view_descriptor(away @ world_from_body[:3, :3], observation.pose)
        at = observation.frame.time_s
        if self._last is not None:
            time_s, before = self._last
            alike = (
                np.linalg.norm(now - before) < MIN_KEYFRAME_DISTANCE
                and abs(at - time_s) < MAX_KEYFRAME_INTERVAL_S
            )
            if alike and not self._initial_left:
                return False
        self._last, self._initial_left = (at, now), max(self._initial_left - 1, 0)
        return True

"""The stream of frames on its way to the trainer: which are held out, and which are redundant."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float, Shaped

from avatar.config import TrainConfig
from avatar.evaluation.held_out import HeldOutFrame
from avatar.rig import Rig
from avatar.training.training_frame import TrainingFrame, prepare_frame
from preprocess.body.body_pose import BodyPose
from preprocess.observation import DroppedFrame, Observation

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


class RedundantFrame(NamedTuple):
    """A frame that is not trained on, because it resembles the keyframe before it."""

    index: int


SplitItem = Observation | HeldOutFrame | DroppedFrame
"""An item of the stream once held-out frames have been separated from those to train on."""
StreamItem = TrainingFrame | HeldOutFrame | DroppedFrame | RedundantFrame
"""An item of the stream as the trainer receives it."""


def is_held_out(position: int, *, stride: int, total: int | None) -> bool:
    """Whether the frame at a position of the stream is held out: 9, 19, 29, ...

    Args:
        position: Number of frames before it.
        stride: Every `stride`-th frame is held out; 0 for none.
        total: Number of frames of the stream, if known. Of fewer than two strides the last quarter
            is held out, at least one frame.
    """
    if stride == 0:
        return False
    if total is not None and total < 2 * stride:
        return total > 1 and position >= total - max(1, total // 4)
    return position % stride == stride - 1


def separate_held_out(
    observations: Iterable[Observation | DroppedFrame], *, stride: int, total: int | None
) -> Iterator[SplitItem]:
    """Wraps the observations that are held out; the only place that decides which these are.

    Args:
        observations: Observations of the whole stream, in its order.
        stride: Every `stride`-th frame is held out; 0 for none.
        total: Number of frames of the stream, if known.

    Yields:
        One item for each observation.
    """
    for position, item in enumerate(observations):
        if isinstance(item, Observation) and is_held_out(position, stride=stride, total=total):
            yield HeldOutFrame(observation=item)
        else:
            yield item


def prepare_items(
    items: Iterable[SplitItem], rig: Rig, *, initial_keyframes: int = INITIAL_KEYFRAMES
) -> Iterator[StreamItem]:
    """Prepares the observations to train on, and passes over redundant ones.

    Args:
        items: Items of `separate_held_out`, some of which may have been dropped since.
        rig: Rig of the person.
        initial_keyframes: Frames that are trained on before any is called redundant.

    Yields:
        One item for each item.
    """
    selector = KeyframeSelector(rig, initial_keyframes=initial_keyframes)
    for item in items:
        if not isinstance(item, Observation):
            yield item
        elif selector.accepts(item):
            yield prepare_frame(item, rig)
        else:
            yield RedundantFrame(index=item.frame.index)


def prepare_stream(
    observations: Iterable[Observation | DroppedFrame],
    rig: Rig,
    *,
    stride: int,
    total: int | None,
    initial_keyframes: int = INITIAL_KEYFRAMES,
) -> Iterator[StreamItem]:
    """Separates held-out frames and prepares the others (`separate_held_out`, `prepare_items`)."""
    split = separate_held_out(observations, stride=stride, total=total)
    return prepare_items(split, rig, initial_keyframes=initial_keyframes)

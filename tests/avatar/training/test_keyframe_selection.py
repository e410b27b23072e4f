"""Which frames of a stream are needed: those that show something new."""

import dataclasses

import numpy as np
import pytest

from avatar.evaluation.held_out import HeldOutFrame
from avatar.training import frame_stream
from avatar.training.frame_stream import (
    JOINT_ANGLE_WEIGHT,
    MAX_KEYFRAME_INTERVAL_S,
    MIN_KEYFRAME_DISTANCE,
    KeyframeSelector,
    RedundantFrame,
    TrainingFrame,
    prepare_stream,
    view_descriptor,
)
from preprocess.body.body_pose import BodyPose


@pytest.fixture(autouse=True)
def no_frame_for_free(monkeypatch):
    monkeypatch.setattr(frame_stream, "INITIAL_KEYFRAMES", 0)


def turned(observation, index, *, angle=0.0, bend=0.0, time_s=None):
    """The same picture in a pose whose root has turned and whose elbow has bent so far."""
    joints = np.zeros((23, 3))
    joints[17, 1] = bend
    pose = dataclasses.replace(
        observation.pose, root_rotation=np.array([0.0, angle, 0.0]), joint_rotations=joints
    )
    frame = dataclasses.replace(
        observation.frame, index=index, time_s=index / 100.0 if time_s is None else time_s
    )
    return dataclasses.replace(observation, frame=frame, pose=pose)


def test_distance_is_the_angle_of_the_view_and_a_share_of_the_joints():
    bent = np.zeros((23, 3))
    bent[4] = [0.3, 0.0, 0.4]
    rest, other = BodyPose.rest(), dataclasses.replace(BodyPose.rest(), joint_rotations=bent)
    front, side = np.array([0.0, 0.0, 3.0]), 7.0 * np.array([np.sin(0.02), 0.0, np.cos(0.02)])
    assert np.linalg.norm(
        view_descriptor(front, rest) - view_descriptor(side, rest)
    ) == pytest.approx(0.02, rel=1e-4)
    apart = np.linalg.norm(view_descriptor(front, rest) - view_descriptor(front, other))
    assert apart == pytest.approx(0.5 * JOINT_ANGLE_WEIGHT)


@pytest.mark.parametrize("what", ["angle", "bend"])
def test_of_a_slow_motion_the_frames_are_taken_that_are_far_enough_apart(rig, clip, what):
    distinct, weight = KeyframeSelector(rig), 1.0 if what == "angle" else JOINT_ANGLE_WEIGHT
    step = 0.3 * MIN_KEYFRAME_DISTANCE / weight
    stream = [turned(clip.observations[0], i, **{what: i * step}) for i in range(13)]
    taken = [i for i, observation in enumerate(stream) if distinct.accepts(observation)]
    assert taken == [0, 4, 8, 12]


def test_as_long_as_there_is_room_every_frame_is_taken(rig, clip, monkeypatch):
    monkeypatch.setattr(frame_stream, "INITIAL_KEYFRAMES", 4)
    distinct = KeyframeSelector(rig)
    stream = [
        turned(clip.observations[0], i, angle=1e-3 * MIN_KEYFRAME_DISTANCE * i) for i in range(9)
    ]
    assert [i for i, seen in enumerate(stream) if distinct.accepts(seen)] == [0, 1, 2, 3]


def test_who_stands_still_is_looked_at_now_and_then(rig, clip):
    distinct, times = KeyframeSelector(rig), np.arange(0.0, 2.01, 0.1)
    stream = [turned(clip.observations[0], i, time_s=t) for i, t in enumerate(times)]
    taken = [
        t for t, observation in zip(times, stream, strict=True) if distinct.accepts(observation)
    ]
    np.testing.assert_allclose(taken, np.arange(0.0, 2.01, MAX_KEYFRAME_INTERVAL_S))


def test_frames_that_are_passed_over_go_by_in_their_order(rig, clip):
    angles = MIN_KEYFRAME_DISTANCE * np.array([0.0, 0.2, 0.4, 2.0, 2.1])
    stream = [turned(clip.observations[0], i, angle=a) for i, a in enumerate(angles)]
    kinds = [type(item) for item in prepare_stream(iter(stream), rig, stride=3, total=None)]
    assert kinds == [TrainingFrame, RedundantFrame, HeldOutFrame, TrainingFrame, RedundantFrame]

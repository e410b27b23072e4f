"""The stream of frames to the trainer: which are held out, which redundant, the others prepared."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float, Float32, Shaped, UInt8

from avatar.config import TrainConfig
from avatar.correspondence_grid import CorrespondenceGrid
from avatar.evaluation.held_out import HeldOutFrame
from avatar.rig import Rig
from avatar.training.training_pixels import (
    PixelRuns,
    RayView,
    TrainingPixels,
    around_person,
    head_pixels,
    near_person_mask,
    picture_head,
    premultiplied_rgba,
)
from capture.camera import Camera
from preprocess.body.body_pose import BodyPose
from preprocess.observation import DroppedFrame, Observation


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainingFrame:
    """An observation as the replay buffer takes it.

    Attributes:
        index: Index of the frame in its source.
        origin: Origin of the rays, body frame, metres.
        body_from_camera: Rotation of the rays.
        colors: Premultiplied RGBA of the pixels near the person; that of the others is zero.
        view: View from which the frame can be rebuilt with its colors alone.
        head: The head's image in the resolution of the video; None where it shows nothing.
    """

    index: int
    pose: BodyPose
    correspondences: CorrespondenceGrid
    origin: Float32[np.ndarray, "3"]
    body_from_camera: Float32[np.ndarray, "3 3"]
    pixels: PixelRuns
    colors: UInt8[np.ndarray, "near 4"]
    view: RayView
    head: TrainingPixels | None

    def directions(self) -> Float32[np.ndarray, "pixels 3"]:
        """Unit directions of all training pixels, body frame; computed at every call."""
        camera = replace(self.view.camera, camera_from_world=np.eye(4))
        row, column = np.divmod(self.pixels.flat_indices(), camera.size_px[0])
        sights = camera.ray_directions(np.stack([column, row], axis=-1) + 0.5)
        return sights.astype(np.float32) @ self.body_from_camera.T


def prepare_frame(observation: Observation, rig: Rig) -> TrainingFrame:
    """Solves the frame's correspondences and selects its training pixels."""
    near = near_person_mask(observation.alpha)
    view = RayView.of(observation.camera, near)
    colors = premultiplied_rgba(observation.person_colors(), observation.alpha, near)
    frame = rebuild_frame(observation.frame.index, observation.pose, view, colors, rig)
    return replace(frame, head=picture_head(observation, rig))


def rebuild_frame(
    index: int,
    pose: BodyPose,
    view: RayView,
    colors: UInt8[np.ndarray, "pixels 4"],
    rig: Rig,
    *,
    head: tuple[RayView, UInt8[np.ndarray, "near 4"]] | None = None,
) -> TrainingFrame:
    """Prepares a frame from what is saved of it: finds its rays, and solves its warp."""
    near = view.near_person()
    origin, body_from_camera = camera_in_body(view.camera, pose, rig)
    return TrainingFrame(
        index=index,
        pose=pose,
        correspondences=CorrespondenceGrid.solve(rig, pose.joint_rotations),
        origin=origin,
        body_from_camera=body_from_camera,
        pixels=PixelRuns.of(near, around_person(near) & ~near),
        colors=colors,
        view=view,
        head=None if head is None else head_pixels(*head),
    )


def camera_in_body(
    camera: Camera, pose: BodyPose, rig: Rig
) -> tuple[Float32[np.ndarray, "3"], Float32[np.ndarray, "3 3"]]:
    """Origin of a camera's rays in the body frame, metres, and their rotation into it."""
    world_from_body = rig.world_from_body(pose)
    camera_from_body = camera.camera_from_world[:3, :3] @ world_from_body[:3, :3]
    origin = (camera.center_world - world_from_body[:3, 3]) @ world_from_body[:3, :3]
    return origin.astype(np.float32), np.ascontiguousarray(camera_from_body.T, dtype=np.float32)


JOINT_ANGLE_WEIGHT = 0.5
"""Weight of a radian of joint rotation relative to a radian of view direction."""
MIN_KEYFRAME_DISTANCE = 0.05
"""Descriptor distance below which two frames show the same view, about 3°."""
INITIAL_KEYFRAMES = TrainConfig.replay_capacity
"""Number of frames that are accepted whatever they show: the default replay capacity."""
MAX_KEYFRAME_INTERVAL_S = 0.5
"""Longest time between keyframes of a person who stands still, seconds."""


def view_descriptor(origin: Shaped[np.ndarray, "3"], pose: BodyPose) -> Float[np.ndarray, " 72"]:
    """View direction and weighted joint rotations; the distance of two resembles an angle, radians.

    `origin` is the camera's center in the body frame, metres.
    """
    facing = origin / np.linalg.norm(origin)
    return np.concatenate([facing, pose.joint_rotations.ravel() * JOINT_ANGLE_WEIGHT])


@final
class KeyframeSelector:
    """Chooses the frames of a long stream that show something new.

    At 30 frames a second most look like the one before: to prepare each would cost more than it
    teaches, and take the time from training.
    """

    def __init__(self, rig: Rig) -> None:
        """Starts without keyframes; the first `INITIAL_KEYFRAMES` frames are all accepted."""
        self._rig, self._initial_left = rig, INITIAL_KEYFRAMES
        self._last: tuple[float, Float[np.ndarray, " 72"]] | None = None

    def accepts(self, observation: Observation) -> bool:
        """Checks whether a frame is worth learning from, after those that were taken before."""
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
    """Checks whether the frame at a position of the stream is held out: 9, 19, 29, ...

    That is every `stride`-th frame; 0 for none. If the stream has a known `total` of fewer than two
    strides, the last quarter is held out, at least one frame.
    """
    if stride == 0:
        return False
    if total is not None and total < 2 * stride:
        return total > 1 and position >= total - max(1, total // 4)
    return position % stride == stride - 1


def separate_held_out(
    observations: Iterable[Observation | DroppedFrame], *, stride: int, total: int | None
) -> Iterator[SplitItem]:
    """Wraps held-out observations, one item for each; alone decides which (`is_held_out`)."""
    for position, item in enumerate(observations):
        if isinstance(item, Observation) and is_held_out(position, stride=stride, total=total):
            yield HeldOutFrame(observation=replace(item, filmed_rgb=None))
        else:
            yield item


def prepare_items(items: Iterable[SplitItem], rig: Rig) -> Iterator[StreamItem]:
    """Prepares the keyframes to train on, one item for each of `separate_held_out`."""
    selector = KeyframeSelector(rig)
    for item in items:
        if not isinstance(item, Observation):
            yield item
        elif selector.accepts(item):
            yield prepare_frame(item, rig)
        else:
            yield RedundantFrame(index=item.frame.index)


def prepare_stream(
    observations: Iterable[Observation | DroppedFrame], rig: Rig, *, stride: int, total: int | None
) -> Iterator[StreamItem]:
    """Separates held-out frames and prepares the others (`separate_held_out`, `prepare_items`)."""
    return prepare_items(separate_held_out(observations, stride=stride, total=total), rig)

"""The stream of frames to the trainer: which are held out, which redundant, the others prepared."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple, final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, Shaped, UInt8

from avatar.config import TrainConfig
from avatar.correspondence_grid import CorrespondenceGrid
from avatar.evaluation.held_out import HeldOutFrame
from avatar.rig import HEAD_JOINT, Rig
from capture.camera import Camera
from preprocess.body.body_pose import BodyPose
from preprocess.body.kinematics import body_from_rest
from preprocess.observation import DroppedFrame, Observation

NEAR_MASK_SHARE = 0.035
"""Distance from the mask within which pixels are near the person, in image heights."""
HEAD_UP_M = 0.08
"""Distance of the head's middle above that joint, metres."""
HEAD_RADIUS_M = 0.16
"""Half of the height of the image rows that hold the head, metres."""
BOX_MARGIN_SHARE = 0.04
"""Margin of the training pixels around the near ones, in image heights."""


class RayView(NamedTuple):
    """Camera and pixels of a training frame.

    Attributes:
        camera: Camera of the image.
        near_person_bits: Mask of the pixels near the person, row by row, eight to a byte.
    """

    camera: Camera
    near_person_bits: UInt8[np.ndarray, "bytes"]


class PixelRuns(NamedTuple):
    """Pixels of an image in runs of adjacent ones: those near the person, then those about them.

    The pixels are numbered through; 100 bytes of runs stand for a thousand pixels.

    Attributes:
        ends: Number of pixels up to the end of each run.
        shifts: Difference between a pixel's flat index in the image and its number, by run.
        near_count: Number of pixels near the person.
    """

    ends: Int32[np.ndarray, "runs"]
    shifts: Int32[np.ndarray, "runs"]
    near_count: int

    @classmethod
    def of(
        cls, near: Bool[np.ndarray, "height width"], far: Bool[np.ndarray, "height width"]
    ) -> "PixelRuns":
        """The runs of two masks."""
        sides = [_run_sides(mask) for mask in (near, far)]
        starts, stops = (np.concatenate(parts) for parts in zip(*sides, strict=True))
        ends = np.cumsum(stops - starts)
        shifts = stops - ends
        return cls(ends.astype(np.int32), shifts.astype(np.int32), int(near.sum()))

    @property
    def count(self) -> int:
        """Number of pixels."""
        return int(self.ends[-1])

    def flat_indices(self) -> Int[np.ndarray, "pixels"]:
        """Flat indices of all pixels in the image."""
        return np.arange(self.count) + np.repeat(self.shifts, np.diff(self.ends, prepend=0))


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainingFrame:
    """An observation as the replay buffer takes it.

    Attributes:
        index: Index of the frame in its source.
        pose: Pose of the body.
        correspondences: Correspondence grid of the pose.
        origin: Origin of the rays, body frame, metres.
        body_from_camera: Rotation of the rays.
        pixels: Training pixels.
        head_pixels: Numbers of the first pixel near the person in the rows of the head, and of the
            first one behind them.
        colors: Premultiplied RGBA of those near the person; that of the others is zero.
        view: View from which the frame can be rebuilt with its colors alone.
    """

    index: int
    pose: BodyPose
    correspondences: CorrespondenceGrid
    origin: Float32[np.ndarray, "3"]
    body_from_camera: Float32[np.ndarray, "3 3"]
    pixels: PixelRuns
    head_pixels: tuple[int, int]
    colors: UInt8[np.ndarray, "near 4"]
    view: RayView

    def directions(self) -> Float32[np.ndarray, "pixels 3"]:
        """Unit directions of all training pixels, body frame; computed at every call."""
        camera = replace(self.view.camera, camera_from_world=np.eye(4))
        row, column = np.divmod(self.pixels.flat_indices(), camera.size_px[0])
        sights = camera.ray_directions(np.stack([column, row], axis=-1) + 0.5)
        return sights.astype(np.float32) @ self.body_from_camera.T


def prepare_frame(observation: Observation, rig: Rig) -> TrainingFrame:
    """Solves the frame's correspondences and selects its training pixels."""
    near = _near_person_mask(observation.alpha)
    view = RayView(camera=observation.camera, near_person_bits=np.packbits(near))
    colors = _premultiplied_rgba(observation, near)
    return _assemble_frame(observation.frame.index, observation.pose, view, near, colors, rig)


def rebuild_frame(
    index: int, pose: BodyPose, view: RayView, colors: UInt8[np.ndarray, "pixels 4"], rig: Rig
) -> TrainingFrame:
    """Makes a frame ready from what is kept of it: finds its rays, and solves its warp."""
    width, height = view.camera.size_px
    bits = np.unpackbits(view.near_person_bits, count=width * height)
    return _assemble_frame(index, pose, view, bits.reshape(height, width) > 0, colors, rig)


def camera_in_body(
    camera: Camera, pose: BodyPose, rig: Rig
) -> tuple[Float32[np.ndarray, "3"], Float32[np.ndarray, "3 3"]]:
    """Where a camera's rays start in the body frame, metres, and their rotation into it."""
    world_from_body = rig.world_from_body(pose)
    camera_from_body = camera.camera_from_world[:3, :3] @ world_from_body[:3, :3]
    origin = (camera.center_world - world_from_body[:3, 3]) @ world_from_body[:3, :3]
    return origin.astype(np.float32), np.ascontiguousarray(camera_from_body.T, dtype=np.float32)


def _assemble_frame(
    index: int,
    pose: BodyPose,
    view: RayView,
    near: Bool[np.ndarray, "height width"],
    colors: UInt8[np.ndarray, "pixels 4"],
    rig: Rig,
) -> TrainingFrame:
    origin, body_from_camera = camera_in_body(view.camera, pose, rig)
    pixels = PixelRuns.of(near, _around(near) & ~near)
    return TrainingFrame(
        index=index,
        pose=pose,
        correspondences=CorrespondenceGrid.solve(rig, pose.joint_rotations),
        origin=origin,
        body_from_camera=body_from_camera,
        pixels=pixels,
        head_pixels=_head_pixels(near, view.camera, rig.world_from_body(pose), pose, rig),
        colors=colors[: pixels.near_count],  # earlier versions saved the others' zeros, too
        view=view,
    )


def _head_pixels(
    near: Bool[np.ndarray, "height width"],
    camera: Camera,
    world_from_body: Float[np.ndarray, "4 4"],
    pose: BodyPose,
    rig: Rig,
) -> tuple[int, int]:
    """Numbers of the pixels near the person in the image rows that hold the head."""
    head = body_from_rest(rig.rest_joints, rig.parents, pose.joint_rotations)[HEAD_JOINT]
    middle = rig.rest_joints[HEAD_JOINT] + np.array([0.0, HEAD_UP_M, 0.0])
    placed = camera.camera_from_world @ world_from_body @ head @ np.append(middle, 1.0)
    if placed[2] < HEAD_RADIUS_M:
        return 0, 0
    row = camera.focal_px[1] * placed[1] / placed[2] + camera.center_px[1]
    reach = camera.focal_px[1] * HEAD_RADIUS_M / placed[2]
    first, last = np.clip(np.rint([row - reach, row + reach]), 0, len(near)).astype(int)
    before = np.count_nonzero(near[:first])
    return int(before), int(before + np.count_nonzero(near[first:last]))


def _premultiplied_rgba(
    observation: Observation, near: Bool[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "near 4"]:
    """Color times alpha, and alpha, of the pixels near the person, in 8 bits."""
    places = np.flatnonzero(near)
    alpha = observation.alpha.reshape(-1).take(places)
    rgb = observation.frame.rgb.reshape(-1, 3).take(places, axis=0)
    premultiplied = np.empty((4, len(places)), dtype=np.float32)
    for channel in range(3):
        np.multiply(rgb[:, channel], alpha, out=premultiplied[channel])
    np.multiply(alpha, np.float32(255.0), out=premultiplied[3])
    rounded = np.rint(premultiplied, out=premultiplied).astype(np.uint8)
    return np.ascontiguousarray(rounded.T)


def _near_person_mask(
    alpha: Float32[np.ndarray, "height width"],
) -> Bool[np.ndarray, "height width"]:
    """The pixels near the person."""
    kernel = np.ones((max(5, int(NEAR_MASK_SHARE * len(alpha)) | 1),) * 2, dtype=np.uint8)
    return cv2.dilate((alpha > 0).astype(np.uint8), kernel) > 0


def _around(near: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """The pixels in a box around those near the person."""
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    margin = int(BOX_MARGIN_SHARE * len(near))
    box = np.zeros_like(near)
    box[
        max(0, rows[0] - margin) : rows[-1] + margin + 1,
        max(0, columns[0] - margin) : columns[-1] + margin + 1,
    ] = True
    return box


def _run_sides(
    mask: Bool[np.ndarray, "height width"],
) -> tuple[Int[np.ndarray, "runs"], Int[np.ndarray, "runs"]]:
    """Flat indices at which the runs of a mask begin, and behind which they end."""
    changes = np.flatnonzero(np.diff(mask.reshape(-1).view(np.int8), prepend=0, append=0))
    return changes[::2], changes[1::2]


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

"""Observations: frames joined with the person's mask, pose and camera, all of one size."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8

from capture.camera import Camera
from capture.image_folder import resize_frame
from capture.input_error import InputError
from capture.source import AlphaMask, Frame, FrameSource, shrink_to_longer_side
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.cameras.camera_file import CameraTrack
from preprocess.frame_association import associate_by_order, associate_by_time
from preprocess.masks.mask_sources import MaskSource
from preprocess.masks.matting import person_colors
from preprocess.tracking.video_tracking import reason_left_out


@dataclass(frozen=True, eq=False, kw_only=True)
class Observation:
    """One training example.

    Attributes:
        alpha: Degree to which each pixel is person, in [0, 1], never thresholded.
        pose: The body's pose in the camera's world.
        camera: The camera, already of the image's size.
        filmed_rgb: The image as it was filmed, where `frame` is a reduced copy; else None.
    """

    frame: Frame
    alpha: AlphaMask
    pose: BodyPose
    camera: Camera
    filmed_rgb: UInt8[np.ndarray, "rows columns 3"] | None = None

    def __post_init__(self) -> None:
        """Refuse images, masks and cameras of different sizes: they are our own bug by now."""
        height, width = self.alpha.shape
        assert self.frame.size_px == (width, height) == self.camera.size_px

    def person_colors(self) -> Float32[np.ndarray, "height width 3"]:
        """The person's own color of each pixel, in levels: that of an image cut out, as it is."""
        if self.frame.alpha is not None:
            return self.frame.rgb.astype(np.float32)
        return person_colors(self.frame.rgb, self.alpha)


@dataclass(frozen=True, kw_only=True)
class DroppedFrame:
    """A frame that cannot be used; `reason` says why, in a few words."""

    index: int
    reason: str


def observation_builder(
    source: FrameSource,
    motion: Motion,
    masks: MaskSource,
    cameras: CameraTrack,
    *,
    size_px: int | None = None,
) -> Callable[[Frame], Observation | DroppedFrame]:
    """Check that the parts fit together, and return a function from a frame to its observation.

    Poses are matched by their frame numbers, their times, or order. `size_px` is the longer side of
    the observations; images are never enlarged.
    """
    row_of, camera_row = associate_poses(motion, source), associate_cameras(cameras, source)
    masks.check()

    def pose_of(frame: Frame) -> BodyPose | str:
        if frame.index in cameras.frames_without_camera:
            return "no camera"
        row = row_of(frame)
        if row is not None and motion.valid[row]:
            return motion[row]
        if motion.keypoints is not None:
            return reason_left_out(motion.keypoints, frame.index)
        return "no pose" if row is None else "pose invalid"

    target_px = shrink_to_longer_side(source.size_px, size_px)
    return lambda frame: join_frame(
        frame, pose_of, lambda index: cameras[camera_row(index)].resize(target_px), masks
    )


def join_frame(
    frame: Frame,
    pose_of: Callable[[Frame], BodyPose | str],
    camera_of: Callable[[int], Camera],
    masks: MaskSource,
) -> Observation | DroppedFrame:
    """Join a frame with its pose, or why it has none, its mask, and its camera, already resized."""
    if "corrupt" in frame.flags:
        return DroppedFrame(index=frame.index, reason="picture damaged")
    pose = pose_of(frame)
    if isinstance(pose, str):
        return DroppedFrame(index=frame.index, reason=pose)
    camera = camera_of(frame.index)
    scaled = resize_frame(frame, camera.size_px)
    try:
        alpha = masks.alpha(frame, scaled, pose, camera)
    except InputError as cause:
        return DroppedFrame(index=frame.index, reason=f"mask unusable: {cause}")
    if not (alpha > 0.5).any():
        return DroppedFrame(index=frame.index, reason="mask empty")
    filmed_rgb = None if scaled is frame else frame.rgb
    return Observation(frame=scaled, alpha=alpha, pose=pose, camera=camera, filmed_rgb=filmed_rgb)


def associate_poses(motion: Motion, source: FrameSource) -> Callable[[Frame], int | None]:
    """Map a frame to its row in the motion, or to None; cheap unless their numbers differ."""
    usable = int(motion.valid.sum())
    if 2 * usable < len(motion):
        raise InputError(
            f"Only {usable} of {len(motion)} poses are usable, the others are NaN or marked as "
            "not valid; at least half were expected. Did the tracker lose the person?"
        )
    if motion.frames is not None:
        rows = {int(frame): row for row, frame in enumerate(motion.frames)}
        if not any(source.selection.contains(f) and 0 <= f < source.frames_in_file for f in rows):
            raise InputError(
                f"The poses belong to the frames {min(rows)} to {max(rows)}, and none of those is "
                f"among the {source.frame_count} wanted frames of {source.path}."
            )
        return lambda frame: rows.get(frame.index)
    if motion.times_s is not None:
        by_time = associate_by_time(motion.times_s, source)
        return lambda frame: by_time(frame.time_s)
    by_order = associate_by_order(len(motion), source, "poses")
    return lambda frame: by_order(frame.index)


def associate_cameras(cameras: CameraTrack, source: FrameSource) -> Callable[[int], int]:
    """Map a frame's number to its camera's row; raise if there are many, but not one a frame."""
    if not cameras.is_moving:
        return lambda index: 0
    return associate_by_order(len(cameras.cameras), source, f"cameras in {cameras.source}")

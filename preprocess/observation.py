"""Observations: frames joined with the person's mask, pose and camera, all of one size."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from capture.atomic_files import OutputFileList
from capture.camera import Camera, same_aspect_ratio
from capture.image_folder import has_cutout_alpha
from capture.input_error import InputError
from capture.source import Frame, FrameSource
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.cameras.camera_file import CameraTrack
from preprocess.frame_association import associate_by_name, associate_by_order, associate_by_time
from preprocess.masks.mask_files import Masks
from preprocess.masks.mask_refinement import GivenMaskRefiner
from preprocess.plugins import Segmenter


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
    alpha: Float32[np.ndarray, "height width"]
    pose: BodyPose
    camera: Camera
    filmed_rgb: UInt8[np.ndarray, "rows columns 3"] | None = None

    def __post_init__(self) -> None:
        """Refuse images, masks and cameras of different sizes: they are our own bug by now."""
        height, width = self.alpha.shape
        assert self.frame.size_px == (width, height) == self.camera.size_px


@dataclass(frozen=True, kw_only=True)
class DroppedFrame:
    """A frame that cannot be used; `reason` says why, in a few words."""

    index: int
    reason: str


def observation_builder(
    source: FrameSource,
    motion: Motion,
    masks: Masks | None,
    cameras: CameraTrack,
    *,
    size_px: int | None = None,
    segment: Segmenter | None = None,
    refine: GivenMaskRefiner | None = None,
) -> Callable[[Frame], Observation | DroppedFrame]:
    """Check that the parts fit together, and return a function from a frame to its observation.

    Args:
        motion: Poses; matched by their frame numbers, by their times, or by order.
        masks: One mask a frame; None if `segment` finds it, or else the alpha channel is the mask.
        cameras: Cameras of the frames' size.
        size_px: Longer side of the observations; images are never enlarged.
        segment: Estimates the mask where there are no `masks`, whatever the alpha channel.
        refine: Refines given masks.
    """
    row_of = associate_poses(motion, source)
    made = masks is None and segment is not None
    mask_row = (lambda index: index) if made else associate_masks(masks, source)
    camera_row = associate_cameras(cameras, source)

    def pose_of(frame: Frame) -> BodyPose | str:
        if frame.index in cameras.frames_without_camera:
            return "no camera"
        row = row_of(frame)
        if row is None:
            return "no pose"
        return motion[row] if motion.valid[row] else "pose invalid"

    def alpha_of(frame: Frame, size_px: tuple[int, int]) -> Float32[np.ndarray, "height width"]:
        if masks is None:
            return alpha_channel_mask(frame, size_px)
        return masks.alpha(mask_row(frame.index), size_px)

    target_px = shrink_to_longer_side(source.size_px, size_px)
    return compose_observation_builder(
        pose_of,
        alpha_of,
        lambda index: cameras[camera_row(index)],
        target_px,
        segment=segment if made else None,
        refine=refine,
    )


def compose_observation_builder(
    pose_of: Callable[[Frame], BodyPose | str],
    alpha_of: Callable[[Frame, tuple[int, int]], Float32[np.ndarray, "height width"]],
    camera_of: Callable[[int], Camera],
    target_px: tuple[int, int],
    *,
    segment: Segmenter | None = None,
    refine: GivenMaskRefiner | None = None,
) -> Callable[[Frame], Observation | DroppedFrame]:
    """Join a frame with its pose, mask and camera, each found by a function of its own.

    Args:
        pose_of: The frame's pose, or why it has none.
        alpha_of: Its mask at a size; raises InputError if it has none.
        camera_of: The camera of a frame's number, of the frames' size.
        target_px: Width and height of the observations.
        segment: Estimates the mask in place of `alpha_of`, once the frame was scaled.
        refine: Refines the mask that `alpha_of` finds.
    """

    def given_alpha(frame: Frame) -> Float32[np.ndarray, "height width"]:
        if refine is None or refine.keeps_given_masks:
            return alpha_of(frame, target_px)
        return refine(frame.rgb, alpha_of(frame, frame.size_px), target_px)

    def joined(frame: Frame) -> Observation | DroppedFrame:
        if "corrupt" in frame.flags:
            return DroppedFrame(index=frame.index, reason="picture damaged")
        pose = pose_of(frame)
        if isinstance(pose, str):
            return DroppedFrame(index=frame.index, reason=pose)
        camera = camera_of(frame.index).resize(target_px)
        try:
            if segment is None:
                alpha, scaled = given_alpha(frame), _resize_frame(frame, target_px)
            else:
                scaled = _resize_frame(frame, target_px)
                alpha = segment(scaled, pose, camera)
        except InputError as cause:
            return DroppedFrame(index=frame.index, reason=f"mask unusable: {cause}")
        if not (alpha > 0.5).any():
            return DroppedFrame(index=frame.index, reason="mask empty")
        filmed_rgb = None if scaled is frame else frame.rgb
        return Observation(
            frame=scaled, alpha=alpha, pose=pose, camera=camera, filmed_rgb=filmed_rgb
        )

    return joined


def associate_poses(motion: Motion, source: FrameSource) -> Callable[[Frame], int | None]:
    """Map a frame to its row in the motion, or to None; cheap unless their numbers differ.

    Raises:
        InputError: If most poses are unusable, none belongs to a selected frame, or rows and
            frames are of different number and nothing tells which belong together.
    """
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


def associate_masks(masks: Masks | None, source: FrameSource) -> Callable[[int], int]:
    """Map a frame's number to its mask's row; the function raises for frames without a mask.

    Raises:
        InputError: If there are none, or of another shape, or not one per frame and their names do
            not tell whose they are.
    """
    if masks is None:
        if source.has_alpha:
            return lambda index: index
        raise InputError(
            f"No masks were found for {source.path}. Give --masks: a folder with one 8-bit picture "
            "a frame, 255 where the person is, or segmenter:blazepose to have them estimated."
        )
    if not same_aspect_ratio(masks.size_px, source.size_px):
        raise InputError(
            f"The masks in {masks.path} have {masks.size_px[0]}x{masks.size_px[1]} px, the frames "
            f"{source.size_px[0]}x{source.size_px[1]}; expected the same shape. Was the video "
            "cropped, rotated or stretched (ffmpeg -vf "
            f"scale={masks.size_px[0]}:{masks.size_px[1]} undoes that)?"
        )
    if masks.names is not None and OutputFileList(masks.path).exists():  # ia-track's own
        rows = {int(name): row for row, name in enumerate(masks.names) if name.isdecimal()}
        if len(rows) == masks.count and max(rows) < source.frames_in_file:
            return _row_by_name(rows, masks)
    if masks.names is not None and masks.count not in (source.frames_in_file, source.frame_count):
        named = associate_by_name(masks.names, source)
        if named is not None:
            return _row_by_name(named, masks)
    return associate_by_order(masks.count, source, f"masks in {masks.path}")


def _row_by_name(named: dict[int, int], masks: Masks) -> Callable[[int], int]:
    """Rows of masks that belong to frames by their names, some of which have none."""

    def row(index: int) -> int:
        if index not in named:
            raise InputError(f"{masks.path} holds none for frame {index}")
        return named[index]

    return row


def associate_cameras(cameras: CameraTrack, source: FrameSource) -> Callable[[int], int]:
    """Map a frame's number to its camera's row; raise if there are many, but not one a frame."""
    if not cameras.is_moving:
        return lambda index: 0
    return associate_by_order(len(cameras.cameras), source, f"cameras in {cameras.source}")


def shrink_to_longer_side(size_px: tuple[int, int], longer_px: int | None) -> tuple[int, int]:
    """Width and height with the longer side shrunk to `longer_px`; never enlarged."""
    if longer_px is None or longer_px >= max(size_px):
        return size_px
    scale = longer_px / max(size_px)
    return max(1, round(size_px[0] * scale)), max(1, round(size_px[1] * scale))


def alpha_channel_mask(
    frame: Frame, size_px: tuple[int, int]
) -> Float32[np.ndarray, "height width"]:
    """The image's own alpha channel, scaled.

    Raises:
        InputError: If it has none, or an opaque one, which does not cut the person out.
    """
    if frame.alpha is None:
        raise InputError("the picture has no alpha channel")
    if not has_cutout_alpha(frame.alpha):
        raise InputError("the picture's alpha channel is opaque, unlike that of others")
    alpha = frame.alpha.astype(np.float32) / np.float32(255.0)
    if frame.size_px == size_px:
        return alpha
    return cv2.resize(alpha, size_px, interpolation=cv2.INTER_AREA)


def _resize_frame(frame: Frame, size_px: tuple[int, int]) -> Frame:
    if frame.size_px == size_px:
        return frame
    alpha = frame.alpha
    return replace(
        frame,
        rgb=cv2.resize(frame.rgb, size_px, interpolation=cv2.INTER_AREA),
        alpha=None if alpha is None else cv2.resize(alpha, size_px, interpolation=cv2.INTER_AREA),
    )

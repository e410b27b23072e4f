"""Training pixels of an image: those near the person in runs of adjacent ones, and those about.

A frame has them twice: people look at faces, and a video is reduced before it is learnt, so that a
head of 270 pixels has 75. The head's are cut out of the frame as it was filmed.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Int, Int32, Shaped, UInt8

from avatar.config import HEAD_SIDE_M, MAX_HEAD_PX
from avatar.rig import Rig
from capture.camera import Camera
from capture.source import AlphaMask
from preprocess.body.body_pose import BodyPose
from preprocess.body.kinematics import HEAD_JOINT, body_from_rest
from preprocess.masks.matting import person_colors
from preprocess.observation import Observation


class RayView(NamedTuple):
    """Camera of a training frame, and the mask of the pixels near the person, packed in bits."""

    camera: Camera
    near_person_bits: UInt8[np.ndarray, "bytes"]

    @classmethod
    def of(cls, camera: Camera, near: Bool[np.ndarray, "height width"]) -> "RayView":
        """The view of a camera whose pixels near the person are known."""
        return cls(camera, np.packbits(near))

    def near_person(self) -> Bool[np.ndarray, "height width"]:
        """Mask of the pixels near the person."""
        width, height = self.camera.size_px
        bits = np.unpackbits(self.near_person_bits, count=width * height)
        return bits.reshape(height, width) > 0


class PixelRuns(NamedTuple):
    """Pixels of an image in runs of adjacent ones: those near the person, then those about them.

    The pixels are numbered through; 100 bytes of runs stand for a thousand pixels. `ends` are the
    numbers of pixels up to the end of each run, `shifts` the differences between a pixel's flat
    index in the image and its number.
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
        return int(self.ends[-1]) if len(self.ends) else 0

    def flat_indices(self) -> Int[np.ndarray, "pixels"]:
        """Flat indices of all pixels in the image."""
        return np.arange(self.count) + np.repeat(self.shifts, np.diff(self.ends, prepend=0))


class TrainingPixels(NamedTuple):
    """The pixels of an image to train on.

    `colors` are premultiplied RGBA of those near the person; that of the others is zero. With the
    colors alone they can be rebuilt from `view`.
    """

    view: RayView
    runs: PixelRuns
    colors: UInt8[np.ndarray, "near 4"]


def premultiplied_rgba(
    rgb: Shaped[np.ndarray, "height width 3"],
    alpha: AlphaMask,
    near: Bool[np.ndarray, "height width"],
) -> UInt8[np.ndarray, "near 4"]:
    """Color times alpha, and alpha, of the pixels near the person, in 8 bits; `rgb` in levels."""
    places = np.flatnonzero(near)
    alphas = alpha.reshape(-1).take(places)
    colors = rgb.reshape(-1, 3).take(places, axis=0)
    premultiplied = np.empty((4, len(places)), dtype=np.float32)
    for channel in range(3):
        np.multiply(colors[:, channel], alphas, out=premultiplied[channel])
    np.multiply(alphas, np.float32(255.0), out=premultiplied[3])
    rounded = np.rint(premultiplied, out=premultiplied).astype(np.uint8)
    return np.ascontiguousarray(rounded.T)


def near_person_mask(alpha: AlphaMask) -> Bool[np.ndarray, "height width"]:
    """The pixels near the person."""
    kernel = np.ones((max(5, int(0.035 * len(alpha)) | 1),) * 2, dtype=np.uint8)
    return cv2.dilate((alpha > 0).astype(np.uint8), kernel) > 0


def around_person(near: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """The pixels in a box around those near the person."""
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    margin = int(0.04 * len(near))
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


def picture_head(observation: Observation, rig: Rig) -> TrainingPixels | None:
    """Cuts out the head; None where no pixel of the person is about it.

    The mask has the size of the reduced frame; enlarged, it follows the edges of the image by
    a guided filter (He et al. 2010).
    """
    rgb, alpha = observation.filmed_rgb, observation.alpha
    if rgb is None:
        rgb = observation.frame.rgb
    height, width = rgb.shape[:2]
    camera = observation.camera.resize((width, height))
    left, top, right, bottom = head_box(camera, observation.pose, rig)
    if right - left < 2 or bottom - top < 2:
        return None
    camera = camera.crop((left, top), (right - left, bottom - top))
    part = np.ascontiguousarray(rgb[top:bottom, left:right])
    if max(camera.size_px) > MAX_HEAD_PX:
        camera = camera.resize_longer_side(MAX_HEAD_PX)
        part = cv2.resize(part, camera.size_px, interpolation=cv2.INTER_AREA)
    scale = np.divide(camera.size_px, (right - left, bottom - top))
    ratio = np.divide(alpha.shape[::-1], (width, height))
    # pixel centers of the picture, in the mask's pixels
    step = ratio / scale
    corner = ratio * (left, top) + 0.5 * step - 0.5
    placed = np.array([[step[0], 0.0, corner[0]], [0.0, step[1], corner[1]]])

    def enlarge(values: np.ndarray, how: int) -> np.ndarray:
        flags = how | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(
            values, placed, camera.size_px, flags=flags, borderMode=cv2.BORDER_REPLICATE
        )

    near = enlarge(near_person_mask(alpha).astype(np.uint8), cv2.INTER_NEAREST) > 0
    if not near.any():
        return None
    large, pixels = enlarge(alpha, cv2.INTER_LINEAR), round(float(1.0 / step.min()))
    if pixels > 1:  # as many of the picture lie across one of the mask
        large = cv2.ximgproc.guidedFilter(part, large, pixels, 100.0)  # variance at an edge
    large = np.clip(large, 0.0, 1.0)
    if observation.frame.alpha is None:  # an image that is cut out shows the person alone
        part = person_colors(part, large)
    colors = premultiplied_rgba(part, large, near)
    return head_pixels(RayView.of(camera, near), colors)


def head_pixels(view: RayView, colors: UInt8[np.ndarray, "near 4"]) -> TrainingPixels:
    """The head's training pixels from what is kept of them: all of them are near the person."""
    near = view.near_person()
    return TrainingPixels(view, PixelRuns.of(near, np.zeros_like(near)), colors)


def head_box(camera: Camera, pose: BodyPose, rig: Rig) -> tuple[int, int, int, int]:
    """Left, upper, right and lower border of the head in the image, pixels."""
    head = body_from_rest(rig.rest_joints, rig.parents, pose.joint_rotations)[HEAD_JOINT]
    middle = rig.rest_joints[HEAD_JOINT] + np.array([0.0, 0.08, 0.0])  # metres, above the joint
    placed = camera.camera_from_world @ rig.world_from_body(pose) @ head @ np.append(middle, 1.0)
    if placed[2] < 0.5 * HEAD_SIDE_M:
        return 0, 0, 0, 0
    center = np.array(camera.focal_px) * placed[:2] / placed[2] + camera.center_px
    reach = np.array(camera.focal_px) * 0.5 * HEAD_SIDE_M / placed[2]
    corners = np.clip(np.rint([center - reach, center + reach]), 0, camera.size_px).astype(int)
    (left, top), (right, bottom) = corners.tolist()
    return left, top, right, bottom

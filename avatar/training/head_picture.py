"""The image of a frame's head, cut out of the frame as it was filmed.

People look at faces, and a video is reduced before it is learnt: a head of 270 pixels has 75 then.
The rest of the body is learnt from the reduced frame.
"""

import cv2
import numpy as np
from jaxtyping import UInt8

from avatar.config import HEAD_SIDE_M, MAX_HEAD_PX
from avatar.rig import Rig
from avatar.training.training_pixels import (
    PixelRuns,
    RayView,
    TrainingPixels,
    near_person_mask,
    premultiplied_rgba,
)
from capture.camera import Camera
from preprocess.body.body_pose import BodyPose
from preprocess.body.kinematics import HEAD_JOINT, body_from_rest
from preprocess.masks.matting import person_colors
from preprocess.observation import Observation

HEAD_UP_M = 0.08
"""Distance of the head's middle above that joint, metres."""
EDGE_VARIANCE = 100.0
"""Variance of colors in 8 bits above which the enlarged mask follows an edge."""


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
        large = cv2.ximgproc.guidedFilter(part, large, pixels, EDGE_VARIANCE)
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
    middle = rig.rest_joints[HEAD_JOINT] + np.array([0.0, HEAD_UP_M, 0.0])
    placed = camera.camera_from_world @ rig.world_from_body(pose) @ head @ np.append(middle, 1.0)
    if placed[2] < 0.5 * HEAD_SIDE_M:
        return 0, 0, 0, 0
    center = np.array(camera.focal_px) * placed[:2] / placed[2] + camera.center_px
    reach = np.array(camera.focal_px) * 0.5 * HEAD_SIDE_M / placed[2]
    corners = np.clip(np.rint([center - reach, center + reach]), 0, camera.size_px).astype(int)
    (left, top), (right, bottom) = corners.tolist()
    return left, top, right, bottom

"""Masks where poses are given: BlazePose's network looks at the posed body.

The poses say which person it is, and where the network has to look. What is far from the posed body
is background, whatever the network says; the rest is as for tracked masks (`MaskRefiner`).
"""

from typing import final

import cv2
import numpy as np
from jaxtyping import Float, Float32

from capture.camera import Camera
from capture.input_error import InputError
from capture.source import Frame
from preprocess.body.body_pose import BodyPose
from preprocess.body.body_surface import NEAR_PLANE_M, SkinPoints
from preprocess.body.parametric_body import ShapedBody
from preprocess.masks.color_models import DarkFilmBrightener
from preprocess.masks.mask_refinement import MaskRefiner
from preprocess.tracking.blazepose_networks import BlazePoseLandmarks, PersonSquare
from preprocess.tracking.keypoints import CroppedMask

HIP_JOINTS, NECK_JOINT = (1, 2), 12
"""SMPL's hips and neck."""
MAX_CLOTHING_M = 0.2
"""Distance from the posed body beyond which all is background, metres: hair, wide clothes and
errors of poses are within."""
BODY_REACH_PX = 2.0
"""Distance from a point of the skin within which a pixel of the network's picture is body."""
MIN_BODY_IOU = 0.4
"""Least IoU of mask and posed body; masks below it are rejected."""


@final
class BlazePoseSegmenter:
    """Segments one person, frame by frame.

    Attributes:
        name: Its name in the report.
        mask_count: Number of masks made.
        agreement: Mean IoU of these masks with the posed body; 0 of none.
    """

    name = "BlazePose"

    def __init__(self, shaped: ShapedBody) -> None:
        """Loads the network."""
        self._shaped, self._skin = shaped, SkinPoints.of(shaped)
        self._brighten, self._find_landmarks = DarkFilmBrightener(), BlazePoseLandmarks()
        self._refine: MaskRefiner | None = None
        self.mask_count, self.agreement = 0, 0.0

    def __call__(
        self, frame: Frame, pose: BodyPose, camera: Camera
    ) -> Float32[np.ndarray, "height width"]:
        """Estimate the mask of a frame; see `Segmenter`.

        Raises:
            InputError: If the body is outside the image, or the mask disagrees with it.
        """
        points = self._skin.posed(pose).astype(np.float64)
        depth = points @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
        pixels = camera.project(points) if depth.min() > NEAR_PLANE_M else np.full((1, 2), -1.0)
        if not ((pixels >= 0.0) & (pixels < frame.size_px)).all(axis=1).any():
            raise InputError("the posed body is not in the image")
        joints = camera.project(self._shaped.with_pose(pose).joints())
        square = _square_around(pixels, joints)
        px_per_m = max(camera.focal_px) / float(np.median(depth))
        mask = self._find_landmarks(self._brighten(frame.rgb), square).keypoints.mask
        mask, agreement = _limit_to_body(mask, pixels, px_per_m)
        if agreement < MIN_BODY_IOU:
            raise InputError(
                f"the estimated mask agrees by {agreement:.0%} only with the posed body"
            )
        self.mask_count += 1
        self.agreement += (agreement - self.agreement) / self.mask_count
        self._refine = self._refine or MaskRefiner(frame.size_px)
        return self._refine(frame.rgb, mask)


def _square_around(
    pixels: Float[np.ndarray, "points 2"], joints: Float[np.ndarray, "24 2"]
) -> PersonSquare:
    """The square in which BlazePose expects a posed body.

    Args:
        pixels: The skin in the frame.
        joints: The joints there.
    """
    hips = joints[list(HIP_JOINTS)].mean(axis=0)
    up = joints[NECK_JOINT] - hips
    radius = np.linalg.norm(pixels - hips, axis=1).max()
    return PersonSquare.around(hips, hips + radius * up / max(float(np.linalg.norm(up)), 1e-6))


def _limit_to_body(
    mask: CroppedMask, pixels: Float[np.ndarray, "points 2"], px_per_m: float
) -> tuple[CroppedMask, float]:
    """Clear a mask far from the posed body.

    Args:
        mask: The network's.
        pixels: The skin in the frame.
        px_per_m: Pixels of the frame per metre at the body.

    Returns:
        The mask, and its IoU with the body.
    """
    turn, offset = mask.image_from_crop[:, :2], mask.image_from_crop[:, 2]
    at = ((pixels - offset) @ np.linalg.inv(turn).T).astype(int)
    height, width = mask.values.shape
    column, row = at[((at >= 0) & (at < (width, height))).all(axis=1)].T
    free = np.ones(mask.values.shape, np.uint8)
    free[row, column] = 0
    away = cv2.distanceTransform(free, cv2.DIST_L2, 3)
    reach = MAX_CLOTHING_M * px_per_m / float(np.hypot(*turn[:, 0]))
    values = np.where(away < reach, mask.values, 0).astype(np.uint8)
    person, body = values > 127, away < BODY_REACH_PX
    iou = float((person & body).sum() / max(int((person | body).sum()), 1))
    return CroppedMask(values=values, image_from_crop=mask.image_from_crop), iou

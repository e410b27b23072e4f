"""Masks as a segmenter gives them: the border wanders in and out.

Poses as a tracker gives them: the truth, and an error that wanders.
"""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import gaussian_filter1d

from capture.camera import Camera
from preprocess.body.body_pose import Motion
from preprocess.body.silhouette import signed_distance_px
from preprocess.poses.root_placement import transform_motion

BORDER_NOISE_SCALE_PX = 6.0
"""How smooth the wandering is along the border."""


def add_mask_noise(
    alpha: Float32[np.ndarray, "height width"], noise_px: float, generator: np.random.Generator
) -> Float32[np.ndarray, "height width"]:
    """The mask with its border moved in and out by smooth noise of `noise_px` (standard deviation).

    The border stays one pixel soft. Without noise the mask is returned as it is.
    """
    if noise_px == 0.0:
        return alpha
    inside_px = -signed_distance_px(alpha >= 0.5)
    white = generator.standard_normal(alpha.shape).astype(np.float32)
    wander = cv2.GaussianBlur(
        white, (0, 0), BORDER_NOISE_SCALE_PX, borderType=cv2.BORDER_REFLECT_101
    )
    wander *= noise_px * 2.0 * np.sqrt(np.pi) * BORDER_NOISE_SCALE_PX  # a blur leaves 1 / (2 √π σ)
    return np.clip(inside_px + wander + 0.5, 0.0, 1.0).astype(np.float32)


NOISE_FRAMES = 3.0
"""A tracker wanders rather than flickers: its error is smooth over about this many frames."""


def add_pose_noise(motion: Motion, *, degrees: float, centimetres: float, seed: int) -> Motion:
    """What a tracker would have said: the motion with smooth noise on rotations and place.

    Args:
        motion: The truth.
        degrees: Standard deviation of each component of each axis-angle.
        centimetres: Standard deviation of each component of the root's place.
        seed: Of the noise.
    """
    if degrees == 0.0 and centimetres == 0.0:
        return motion
    generator = np.random.default_rng([seed, 3])
    frames = len(motion)
    turned = _smooth_noise(generator, (frames, 24, 3)) * np.deg2rad(degrees)
    moved = _smooth_noise(generator, (frames, 3)) * centimetres / 100.0
    return replace(
        motion,
        root_rotations=motion.root_rotations + turned[:, 0],
        root_translations=motion.root_translations + moved,
        joint_rotations=motion.joint_rotations + turned[:, 1:],
    )


def to_camera_space(
    motion: Motion, cameras: tuple[Camera, ...], pelvis: Float[np.ndarray, "3"]
) -> Motion:
    """The motion as a tracker tells it that knows no world: each row in its frame's camera, with K.

    Args:
        motion: In the world, a row a frame.
        cameras: One for each frame.
        pelvis: Where the person's pelvis rests.
    """
    views = np.stack([camera.camera_from_world for camera in cameras])
    return replace(
        transform_motion(motion, views, pelvis), space="camera", intrinsic=cameras[0].intrinsic
    )


def _smooth_noise(
    generator: np.random.Generator, shape: tuple[int, ...]
) -> Float[np.ndarray, "frames *rest"]:
    """Gaussian noise of unit variance, smooth over `NOISE_FRAMES` frames."""
    margin = int(4 * NOISE_FRAMES)
    white = generator.standard_normal((shape[0] + 2 * margin, *shape[1:]))
    smooth = gaussian_filter1d(white, NOISE_FRAMES, axis=0)[margin:-margin]
    # The power of a Gaussian filter: its variance falls to 1 / (2 √π σ).
    return smooth * np.sqrt(2.0 * np.sqrt(np.pi) * NOISE_FRAMES)

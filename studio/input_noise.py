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
    alpha: Float32[np.ndarray, "height width"],
    noise_px: float,
    generator: np.random.Generator,
    *,
    grown_px: float = 0.0,
    soft_px: float = 1.0,
) -> Float32[np.ndarray, "height width"]:
    """The mask with its border moved in and out by smooth noise.

    Args:
        alpha: The exact mask; returned as it is if there is no noise.
        noise_px: Standard deviation of the border.
        generator: Where the noise comes from.
        grown_px: How far the whole border is moved outwards.
        soft_px: Width of the border's ramp from 0 to 1.
    """
    if noise_px == 0.0:
        return alpha
    inside_px = -signed_distance_px(alpha >= 0.5)
    white = generator.standard_normal(alpha.shape).astype(np.float32)
    wander = cv2.GaussianBlur(
        white, (0, 0), BORDER_NOISE_SCALE_PX, borderType=cv2.BORDER_REFLECT_101
    )
    wander *= noise_px * 2.0 * np.sqrt(np.pi) * BORDER_NOISE_SCALE_PX  # a blur leaves 1 / (2 √π σ)
    moved = (inside_px + grown_px + wander) / soft_px
    return np.clip(moved + 0.5, 0.0, 1.0).astype(np.float32)


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
    turned = smooth_noise(generator, (frames, 24, 3)) * np.deg2rad(degrees)
    moved = smooth_noise(generator, (frames, 3)) * centimetres / 100.0
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


def smooth_noise(
    generator: np.random.Generator, shape: tuple[int, ...], over: float = NOISE_FRAMES
) -> Float[np.ndarray, "frames *rest"]:
    """Gaussian noise of unit variance, smooth over a number of frames (a Gaussian's width).

    Args:
        generator: Where the noise comes from.
        shape: Frames, and what each has.
        over: Standard deviation of the smoothing, frames.
    """
    margin = max(1, int(4 * over))
    white = generator.standard_normal((shape[0] + 2 * margin, *shape[1:]))
    smooth = gaussian_filter1d(white, over, axis=0)[margin : margin + shape[0]]
    # The power of a Gaussian filter: its variance falls to 1 / (2 √π σ).
    return smooth * np.sqrt(2.0 * np.sqrt(np.pi) * over)

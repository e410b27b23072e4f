"""A little motion that no video has shown: the avatar turns round, waves and lifts its knees."""

import numpy as np
from jaxtyping import Float

from preprocess.pose import Motion

L_HIP, R_HIP, L_KNEE, R_KNEE, L_SHOULDER, R_SHOULDER, L_ELBOW, R_ELBOW = range(8)
_JOINTS = np.array([1, 2, 4, 5, 16, 17, 18, 19]) - 1


def demo_motion(frames: int = 48, *, fps: float = 16.0) -> Motion:
    """One turn at the world's origin; the last pose leads back to the first.

    Args:
        frames: How many poses.
        fps: Poses a second.
    """
    phase = np.linspace(0.0, 2.0 * np.pi, frames, endpoint=False)
    steps = np.sin(2.0 * phase)
    joints = np.zeros((frames, 23, 3))
    limbs = np.zeros((frames, 8, 3))
    limbs[:, L_HIP, 0], limbs[:, R_HIP, 0] = -0.9 * _positive_part(steps), -0.9 * _positive_part(-steps)
    limbs[:, L_KNEE, 0], limbs[:, R_KNEE, 0] = 1.3 * _positive_part(steps), 1.3 * _positive_part(-steps)
    limbs[:, L_HIP, 2], limbs[:, R_HIP, 2] = 0.08, -0.08
    limbs[:, L_SHOULDER, 2] = -0.85 + 0.75 * (1.0 - np.cos(phase))
    limbs[:, R_SHOULDER, 2] = 0.85 - 0.35 * (1.0 - np.cos(2.0 * phase))
    limbs[:, L_ELBOW, 2] = 0.35 + 0.3 * np.sin(4.0 * phase)
    limbs[:, R_ELBOW, 1] = 0.5 * (1.0 - np.cos(phase))
    joints[:, _JOINTS] = limbs
    root = np.zeros((frames, 3))
    root[:, 1] = phase
    return Motion(
        root_rotations=root,
        root_translations=np.zeros((frames, 3)),
        joint_rotations=joints,
        valid=np.ones(frames, dtype=bool),
        betas=np.zeros(10),
        body_model="body24",
        times_s=np.arange(frames) / fps,
    )


def _positive_part(wave: Float[np.ndarray, "frames"]) -> Float[np.ndarray, "frames"]:
    return np.maximum(wave, 0.0)

"""Motions that drive an avatar: read from a file or built in, and resampled to a frame rate."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from apps.cli.console import Console
from capture.input_error import InputError
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.kinematics import slerp
from preprocess.poses.motion_builder import anchor_at_pelvis
from preprocess.poses.plausibility import plausibility_warnings, require_plausible
from preprocess.poses.pose_format_registry import read_poses


def pose_rate(motion: Motion) -> float:
    """Return the poses per second of a motion, by its times; 30 without plausible times."""
    if motion.times_s is None or len(motion) < 2:
        return 30.0
    step = float(np.median(np.diff(motion.times_s)))
    return round(1.0 / step, 3) if 1.0 / 240.0 <= step <= 10.0 else 30.0


# limbs that the built-in motion moves, and their SMPL joints
L_HIP, R_HIP, L_KNEE, R_KNEE, L_SHOULDER, R_SHOULDER, L_ELBOW, R_ELBOW = range(8)
_JOINTS = np.array([1, 2, 4, 5, 16, 17, 18, 19]) - 1


def demo_motion(frames: int = 48, *, fps: float = 16.0) -> Motion:
    """Turn once at the world's origin, wave and lift the knees; the motion is a loop.

    Args:
        frames: Number of poses.
        fps: Poses per second.
    """
    phase = np.linspace(0.0, 2.0 * np.pi, frames, endpoint=False)
    steps = np.sin(2.0 * phase)
    joints = np.zeros((frames, 23, 3))
    limbs = np.zeros((frames, 8, 3))
    limbs[:, L_HIP, 0], limbs[:, R_HIP, 0] = (
        -0.9 * _positive_part(steps),
        -0.9 * _positive_part(-steps),
    )
    limbs[:, L_KNEE, 0], limbs[:, R_KNEE, 0] = (
        1.3 * _positive_part(steps),
        1.3 * _positive_part(-steps),
    )
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


def load_driving_motion(
    path: Path,
    rest_joints: Float[np.ndarray, "24 3"],
    console: Console,
    *,
    person: str | None = None,
) -> Motion:
    """Read poses from a file and anchor them at the avatar's pelvis.

    Args:
        path: A pose file of any format that `preprocess.poses` reads.
        rest_joints: Rest joints of the avatar, meters.
        console: Shows notes and warnings about the poses.
        person: Person ID in the file; None for the longest track.

    Raises:
        InputError: If no pose is valid, or the numbers cannot be radians and meters.
    """
    read = require_plausible(read_poses(path, person=person, prefer_world=True), path)
    motion = anchor_at_pelvis(read, rest_joints)
    if motion.note is not None:
        console.info(f"note: {motion.note}")
    for sentence in plausibility_warnings(read):
        console.warning(sentence)
    lost = int((~motion.valid).sum())
    if lost == len(motion):
        raise InputError(f"None of the {len(motion)} poses in {path} is valid.")
    if lost:
        console.warning(f"{lost} of {len(motion)} poses are invalid and were skipped.")
    return motion


MAX_FPS = 60.0
"""Largest default frame rate: of motion capture at 120 Hz every second pose is shown."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ResampledMotion:
    """A motion sampled at a constant frame rate.

    Attributes:
        motion: The motion.
        valid_rows: Rows of its valid poses, in order.
        fps: Frames per second.
        positions: Position of each frame in `valid_rows`; fractional between two rows.
    """

    motion: Motion
    valid_rows: Int[np.ndarray, "valid"]
    fps: float
    positions: Float[np.ndarray, "frames"]

    @classmethod
    def of(cls, motion: Motion, *, fps: float | None, speed: float = 1.0) -> "ResampledMotion":
        """Resample a motion; without times, it has one pose per frame.

        Args:
            motion: Has at least one valid pose.
            fps: Frames per second; None for the motion's own rate, divided by an integer to stay
                within `MAX_FPS`.
            speed: Factor on the speed of the motion.
        """
        rows, rate = np.flatnonzero(motion.valid), pose_rate(motion)
        pace = fps or rate / float(np.ceil(rate / MAX_FPS - 1e-6))
        step = speed if motion.times_s is None else speed * rate / pace
        step = 1.0 if abs(step - 1.0) < 1e-3 else step
        count = int((len(rows) - 1) / step + 1e-6) + 1
        return cls(motion=motion, valid_rows=rows, fps=pace, positions=step * np.arange(count))

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.positions)

    def pose(self, frame: int) -> BodyPose:
        """Return the pose of a frame: slerp of rotations, linear root translation."""
        before, share = self._split_position(frame)
        first = self.motion[int(self.valid_rows[before])]
        if share < 1e-6:
            return first
        last = self.motion[int(self.valid_rows[before + 1])]
        turned = slerp(_rotations(first), _rotations(last), np.array([share]))[0]
        way = last.root_translation - first.root_translation
        return BodyPose(
            root_rotation=turned[0],
            root_translation=first.root_translation + share * way,
            joint_rotations=turned[1:],
        )

    def nearest_row(self, frame: int) -> int:
        """Return the row of the motion nearest to a frame."""
        before, share = self._split_position(frame)
        return int(self.valid_rows[before + (share >= 0.5)])

    def _split_position(self, frame: int) -> tuple[int, float]:
        place = min(float(self.positions[frame]), len(self.valid_rows) - 1.0)
        before = int(place + 1e-6)
        return before, max(0.0, place - before)


def _rotations(pose: BodyPose) -> Float[np.ndarray, "24 3"]:
    return np.concatenate([pose.root_rotation[None], pose.joint_rotations])

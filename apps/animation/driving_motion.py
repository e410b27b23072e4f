"""How fast a motion goes by its own times.

A little motion that no video has shown: the avatar turns round, waves and lifts its knees.

Poses that an avatar is driven with, whoever wrote them.

Which pose each picture of a clip shows, so that a motion keeps its own pace.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from apps.cli.console import Console
from capture.input_error import InputError
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.rotations import slerp
from preprocess.pose_formats.pose_format_registry import read_poses
from preprocess.poses.plausibility import plausibility_warnings, require_plausible
from preprocess.poses.root_placement import anchor_at_pelvis


def pose_rate(motion: Motion) -> float:
    """By the times of its poses; 30 if it has none that can be."""
    if motion.times_s is None or len(motion) < 2:
        return 30.0
    step = float(np.median(np.diff(motion.times_s)))
    return round(1.0 / step, 3) if 1.0 / 240.0 <= step <= 10.0 else 30.0


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
    """The poses of a file, about the avatar's own pelvis.

    Args:
        path: Whatever `preprocess.poses` reads.
        rest_joints: The avatar's, metres.
        console: Hears what the user should know about the poses.
        person: Whose poses; None: of whom there are most.

    Raises:
        InputError: If there are none, or the numbers cannot be poses in radians and metres.
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
        console.warning(f"{lost} of {len(motion)} poses are not valid; left out.")
    return motion


MAX_FPS = 60.0
"""Pictures a second if nobody says: motion capture of 120 poses a second shows every second one."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ResampledMotion:
    """Pictures at an even pace, and where in the motion each of them lies.

    Attributes:
        motion: What is shown.
        rows: The poses of it that are valid, in order.
        fps: Pictures a second.
        places: For each picture, how far it is along `rows`; between two where it is no integer.
    """

    motion: Motion
    valid_rows: Int[np.ndarray, "valid"]
    fps: float
    positions: Float[np.ndarray, "pictures"]

    @classmethod
    def of(cls, motion: Motion, *, fps: float | None, speed: float = 1.0) -> "ResampledMotion":
        """The pictures of a motion.

        A motion without times is as fast as its pictures: one for each pose.

        Args:
            motion: With at least one valid pose.
            fps: Pictures a second; the motion's own pace if None, if need be every second or third
                pose of it.
            speed: How many times faster than it was.
        """
        rows, rate = np.flatnonzero(motion.valid), pose_rate(motion)
        pace = fps or rate / float(np.ceil(rate / MAX_FPS - 1e-6))
        step = speed if motion.times_s is None else speed * rate / pace
        step = 1.0 if abs(step - 1.0) < 1e-3 else step
        count = int((len(rows) - 1) / step + 1e-6) + 1
        return cls(motion=motion, valid_rows=rows, fps=pace, positions=step * np.arange(count))

    def __len__(self) -> int:
        """How many pictures there are."""
        return len(self.positions)

    def pose(self, frame: int) -> BodyPose:
        """The pose of a picture: slerp between neighbours, straight lines for the root's place."""
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
        """The row of the motion that is nearest to a picture."""
        before, share = self._split_position(frame)
        return int(self.valid_rows[before + (share >= 0.5)])

    def _split_position(self, frame: int) -> tuple[int, float]:
        place = min(float(self.positions[frame]), len(self.valid_rows) - 1.0)
        before = int(place + 1e-6)
        return before, max(0.0, place - before)


def _rotations(pose: BodyPose) -> Float[np.ndarray, "24 3"]:
    return np.concatenate([pose.root_rotation[None], pose.joint_rotations])

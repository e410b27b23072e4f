"""Which pose each picture of a clip shows, so that a motion keeps its own pace."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from apps.playing.rate import pose_rate
from preprocess.pose import BodyPose, Motion
from preprocess.rotations import slerp

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
        return cls(motion=motion, rows=rows, fps=pace, places=step * np.arange(count))

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

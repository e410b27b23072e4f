"""Poses of the live viewer: the newest frame's, standing, the filmed motion, or a dance.

All poses are in the page's world: pelvis at the origin, y up, and the filming camera looks along
-z, so that the initial view shows the person as the video does.
"""

from typing import final

import numpy as np

from apps.animation.driving_motion import demo_motion
from avatar.rig import canonical_rotations
from capture.camera import Camera
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.kinematics import rotation_matrices
from preprocess.capture_session import Capture
from preprocess.observation import Observation

NEWEST, STANDING, FILMED, DANCE = "Newest", "Standing", "Filmed", "Dance"
"""Labels of the buttons."""
POSE_CHOICES = (NEWEST, STANDING, FILMED, DANCE)
"""Buttons in order."""
DEFAULT_FPS = 30.0
"""Frame rate of a motion without times."""


@final
class PreviewPoses:
    """Poses by the user's choice and by time."""

    def __init__(self, recording: Capture) -> None:
        """Take body and filmed motion from a capture."""
        self._pelvis = recording.shaped.joints[0]
        self._cameras = recording.cameras
        self._filmed, self._dance = recording.motion, demo_motion()
        self._valid = np.flatnonzero(recording.motion.valid)

    def pose_at(self, choice: str, seconds: float, newest: Observation | None) -> BodyPose:
        """Return the pose to show.

        Args:
            choice: One of `POSE_CHOICES`.
            seconds: Time since the motion started; motions are looped.
            newest: The newest frame; None before the first.
        """
        if choice == FILMED:
            place = np.searchsorted(self._valid, _row_at(self._filmed, seconds))
            row = int(self._valid[min(place, len(self._valid) - 1)])
            return self._align_to_camera(self._filmed[row], self._camera_of_row(row))
        if choice == DANCE:
            pose = self._dance[_row_at(self._dance, seconds)]
            return self._center_on_pelvis(pose.root_rotation, pose)
        if choice == NEWEST and newest is not None:
            return self._align_to_camera(newest.pose, newest.camera)
        standing = BodyPose(
            root_rotation=np.zeros(3),
            root_translation=np.zeros(3),
            joint_rotations=canonical_rotations(),
        )
        return self._center_on_pelvis(standing.root_rotation, standing)

    def _camera_of_row(self, row: int) -> Camera:
        """Return the camera that filmed a row of the motion."""
        frames, track = self._filmed.frames, self._cameras
        frame = row if frames is None else int(frames[row])
        return track[min(frame, len(track.cameras) - 1)]

    def _align_to_camera(self, pose: BodyPose, camera: Camera) -> BodyPose:
        """Rotate a pose so that the page's camera sees what the filming camera saw."""
        page_from_camera = np.diag([1.0, -1.0, -1.0])
        turned = page_from_camera @ camera.camera_from_world[:3, :3]
        return self._center_on_pelvis(
            _axis_angle(turned @ rotation_matrices(pose.root_rotation)), pose
        )

    def _center_on_pelvis(self, root_rotation: np.ndarray, pose: BodyPose) -> BodyPose:
        """Move the pelvis to the origin: the root rotates about its rest position J0."""
        return BodyPose(
            root_rotation=root_rotation,
            root_translation=-self._pelvis,
            joint_rotations=pose.joint_rotations,
        )


def _row_at(motion: Motion, seconds: float) -> int:
    """Return the row of a motion that is shown after `seconds`."""
    times = motion.times_s
    if times is None or len(times) < 2 or not np.isfinite(times).all() or times[-1] <= times[0]:
        return int(seconds * DEFAULT_FPS) % len(motion)
    length = (times[-1] - times[0]) * len(times) / (len(times) - 1)
    return int(np.searchsorted(times - times[0], seconds % length, side="right")) - 1


def _axis_angle(rotation: np.ndarray) -> np.ndarray:
    """Convert a rotation matrix to axis-angle."""
    import cv2

    vector, _ = cv2.Rodrigues(rotation)
    return np.asarray(vector, dtype=np.float64).reshape(3)

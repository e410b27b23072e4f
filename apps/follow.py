"""The camera that nobody had to give: it follows the pelvis and shows the whole person."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from capture.camera import Camera
from export.player import Player
from preprocess.kinematics import rotation_matrices
from preprocess.pose import BodyPose, Motion

SHARE = 0.8
"""Of the picture's height, how much the standing person takes."""
AWAY = 3.5
"""How far the camera stands, in heights of the person."""
MEASURED_PX = 192


@dataclass(frozen=True, eq=False, kw_only=True)
class FollowingCamera:
    """A square picture in front of the first pose, upright as that pose is.

    Trackers do not know where up is; a body's first pose mostly does.

    Attributes:
        size_px: Width and height.
        axes: Rows: the picture's right, down and forward in the world.
        pelvis: Rest pelvis, metres.
        height_m: Of the person standing.
        middle_m: How far the person's middle is above the pelvis.
    """

    size_px: int
    axes: Float[np.ndarray, "3 3"]
    pelvis: Float[np.ndarray, "3"]
    height_m: float
    middle_m: float

    @classmethod
    def of(cls, player: Player, motion: Motion, size_px: int) -> "FollowingCamera":
        """A camera for a motion; the person is measured in a small picture of a standing pose."""
        pelvis = player.manifest.rest_joints[0]
        first = int(np.flatnonzero(motion.valid)[0])
        facing = np.diag([1.0, -1.0, -1.0]) @ rotation_matrices(motion.root_rotations[first]).T
        guess = cls(
            size_px=MEASURED_PX,
            axes=np.diag([1.0, -1.0, -1.0]),
            pelvis=pelvis,
            height_m=2.2,
            middle_m=0.0,
        )
        standing = BodyPose(
            root_rotation=np.zeros(3),
            root_translation=np.zeros(3),
            joint_rotations=player.manifest.canonical_rotations,
        )
        rows = np.flatnonzero((player.render(standing, guess.at(standing))[..., 3] > 127).any(1))
        if not len(rows):  # nothing to be seen: leave it at the guess
            rows = np.array([0, MEASURED_PX - 1])
        metres = 2.2 / SHARE / MEASURED_PX
        return cls(
            size_px=size_px,
            axes=facing,
            pelvis=pelvis,
            height_m=float(rows[-1] + 1 - rows[0]) * metres,
            middle_m=float(MEASURED_PX - rows[0] - rows[-1] - 1) / 2.0 * metres,
        )

    def at(self, pose: BodyPose) -> Camera:
        """The camera for one pose."""
        distance = AWAY * self.height_m
        focal = SHARE * self.size_px * distance / self.height_m
        center = self.pelvis + pose.root_translation
        camera_from_world = np.eye(4)
        camera_from_world[:3, :3] = self.axes
        camera_from_world[:3, 3] = [0.0, self.middle_m, distance] - self.axes @ center
        return Camera(
            focal_px=(focal, focal),
            center_px=(self.size_px / 2.0, self.size_px / 2.0),
            size_px=(self.size_px, self.size_px),
            camera_from_world=camera_from_world,
        )

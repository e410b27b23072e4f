"""Default camera: follows the person and shows the whole body."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from apps.animation.viewpoint import Viewpoint
from capture.camera import Camera
from export.player import Player
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.kinematics import (
    JOINT_NAMES,
    body_from_rest,
    rotation_matrices,
    world_from_body,
)

PERSON_HEIGHT_SHARE = 0.8
"""Height of the standing person as a fraction of the image height."""
MAX_HEIGHT_OVER_WIDTH = 1.5
"""Aspect ratio beyond which the person is shown smaller, so that arms fit in."""
DISTANCE_HEIGHTS = 3.5
"""Distance of the camera, in heights of the person."""
MEASURING_PX = 192
"""Size of the image in which the person is measured."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FollowingCamera:
    """A camera in front of the first pose of a motion, upright as that pose is.

    Trackers do not know the vertical; the first pose of a body mostly shows it.

    Attributes:
        size_px: Width and height.
        level_axes: Rows: right, down and forward of a level image from the front, in the world.
        player: Player of the avatar.
        height_m: Height of the standing person.
        center_above_pelvis_m: Height of the person's center above the pelvis.
        viewpoint: Where the camera stands.
    """

    size_px: tuple[int, int]
    level_axes: Float[np.ndarray, "3 3"]
    player: Player
    height_m: float
    center_above_pelvis_m: float
    viewpoint: Viewpoint

    @classmethod
    def of(
        cls,
        player: Player,
        motion: Motion,
        size_px: int | tuple[int, int],
        viewpoint: Viewpoint | None = None,
    ) -> "FollowingCamera":
        """Build the camera for a motion; measure the person in a small image of a standing pose.

        Args:
            player: Renders that image.
            motion: Its first valid pose defines front and up.
            size_px: Width and height; one number for a square.
            viewpoint: Where the camera stands; None for the front.
        """
        first = int(np.flatnonzero(motion.valid)[0])
        guess = cls(
            size_px=(MEASURING_PX, MEASURING_PX),
            level_axes=np.diag([1.0, -1.0, -1.0]),
            player=player,
            height_m=2.2,
            center_above_pelvis_m=0.0,
            viewpoint=Viewpoint(),
        )
        standing = canonical_pose_of(player)
        rows = np.flatnonzero(
            (player.render(standing, guess.camera_for(standing))[..., 3] > 127).any(1)
        )
        if not len(rows):  # nothing visible: keep the guess
            rows = np.array([0, MEASURING_PX - 1])
        metres = 2.2 / PERSON_HEIGHT_SHARE / MEASURING_PX
        return replace(
            guess,
            size_px=(size_px, size_px) if isinstance(size_px, int) else size_px,
            level_axes=np.diag([1.0, -1.0, -1.0])
            @ rotation_matrices(motion.root_rotations[first]).T,
            height_m=float(rows[-1] + 1 - rows[0]) * metres,
            center_above_pelvis_m=float(MEASURING_PX - rows[0] - rows[-1] - 1) / 2.0 * metres,
            viewpoint=viewpoint or Viewpoint(),
        )

    def camera_for(self, pose: BodyPose, seconds: float = 0.0) -> Camera:
        """Return the camera for a pose, `seconds` after the first frame."""
        view, (width, height) = self.viewpoint, self.size_px
        away = DISTANCE_HEIGHTS * self.height_m
        focal = (
            PERSON_HEIGHT_SHARE
            * min(height, MAX_HEIGHT_OVER_WIDTH * width)
            * away
            / self.height_m
            * view.zoom
        )
        axes = view.rotation_at(seconds) @ self.level_axes
        camera_from_world = np.eye(4)
        camera_from_world[:3, :3] = axes
        camera_from_world[:3, 3] = -axes @ self._look_at_point(pose)
        camera_from_world[2, 3] += view.distance_m or away
        return Camera(
            focal_px=(focal, focal),
            center_px=(width / 2.0, height / 2.0),
            size_px=self.size_px,
            camera_from_world=camera_from_world,
        )

    def _look_at_point(self, pose: BodyPose) -> Float[np.ndarray, "3"]:
        """Return the world point in the center of the image."""
        manifest, joint = self.player.manifest, self.viewpoint.joint
        pelvis = manifest.rest_joints[0]
        if joint is None:
            return pelvis + pose.root_translation - self.center_above_pelvis_m * self.level_axes[1]
        number = JOINT_NAMES.index(joint)
        body = body_from_rest(manifest.rest_joints, manifest.parents, pose.joint_rotations)
        world = world_from_body(pelvis, pose.root_rotation, pose.root_translation) @ body[number]
        return world[:3, :3] @ manifest.rest_joints[number] + world[:3, 3]


def canonical_pose_of(player: Player) -> BodyPose:
    """Return the canonical pose of an avatar: upright, arms slightly away from the body."""
    return BodyPose(
        root_rotation=np.zeros(3),
        root_translation=np.zeros(3),
        joint_rotations=player.manifest.canonical_rotations,
    )

"""Rendering of the avatar for a browser's camera."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from avatar.deformation.correspondence_grid import CorrespondenceGrid
from avatar.field.avatar_model import Avatar
from avatar.render import render
from capture.camera import Camera
from preprocess.body.body_pose import BodyPose

BACKGROUND_RGB = (251, 250, 247)
"""Background color of the page, as in report.html."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BrowserCamera:
    """Camera of a browser, as viser reports it (OpenCV axes).

    Attributes:
        world_from_camera: Rotation.
        position: Position in the world, meters.
        fov: Vertical field of view, radians.
        aspect: Width over height.
        moved_at: Time of its last motion, on `time.perf_counter`'s clock.
    """

    world_from_camera: Float[np.ndarray, "3 3"]
    position: Float[np.ndarray, "3"]
    fov: float
    aspect: float
    moved_at: float

    def to_camera(self, height_px: int) -> Camera:
        """Convert to a camera with this image height."""
        width_px = max(1, round(height_px * self.aspect))
        focal = 0.5 * height_px / np.tan(0.5 * self.fov)
        camera_from_world = np.eye(4)
        camera_from_world[:3, :3] = self.world_from_camera.T
        camera_from_world[:3, 3] = -self.world_from_camera.T @ self.position
        return Camera(
            focal_px=(float(focal), float(focal)),
            center_px=(width_px / 2.0, height_px / 2.0),
            size_px=(width_px, height_px),
            camera_from_world=camera_from_world,
        )


def render_preview(
    avatar: Avatar, pose: BodyPose, camera: Camera, *, cells: CorrespondenceGrid
) -> UInt8[np.ndarray, "height width 3"]:
    """Render the avatar in its current state over the page's background.

    Args:
        avatar: The avatar.
        pose: Pose in the camera's world.
        camera: Also defines the image size.
        cells: Correspondence grid of the pose.
    """
    rgba = render(avatar, pose, camera, cells=cells)
    mixed = rgba[..., :3] * 255.0 + (1.0 - rgba[..., 3:]) * np.array(
        BACKGROUND_RGB, dtype=np.float32
    )
    return np.clip(mixed + 0.5, 0.0, 255.0).astype(np.uint8)

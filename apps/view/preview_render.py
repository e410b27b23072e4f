"""What a browser's camera sees: its pose as a Camera, and the avatar drawn for it on paper."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from avatar.deformation.correspondence_grid import CorrespondenceGrid
from avatar.field.avatar_model import Avatar
from avatar.render import render
from capture.camera import Camera
from preprocess.body.body_pose import BodyPose

BACKGROUND_RGB = (251, 250, 247)
"""The colour that everything stands on; report.html's."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BrowserCamera:
    """Where a browser's camera is, as viser says it (OpenCV axes).

    Attributes:
        world_from_camera: Rotation.
        position: In the world, metres.
        fov: From the picture's top to its bottom, radians.
        aspect: Width over height.
        moved_at: When it moved last, on `time.perf_counter`'s clock.
    """

    world_from_camera: Float[np.ndarray, "3 3"]
    position: Float[np.ndarray, "3"]
    fov: float
    aspect: float
    moved_at: float

    def to_camera(self, height_px: int) -> Camera:
        """The same as a camera whose picture is so high."""
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
    """The avatar, as learnt so far, on paper.

    Args:
        avatar: Who.
        pose: In the camera's world.
        camera: Also says how large the picture is.
        cells: The pose's warp.
    """
    rgba = render(avatar, pose, camera, cells=cells)
    mixed = rgba[..., :3] * 255.0 + (1.0 - rgba[..., 3:]) * np.array(
        BACKGROUND_RGB, dtype=np.float32
    )
    return np.clip(mixed + 0.5, 0.0, 255.0).astype(np.uint8)

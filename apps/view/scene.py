"""What a browser's camera sees: its pose as a Camera, and the avatar drawn for it on paper."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt8

from avatar.cells import WarpCells
from avatar.coverage import posed
from avatar.model import Avatar
from avatar.patches import SkinPatches
from avatar.render import render
from capture.camera import Camera
from preprocess.body import ShapedBody
from preprocess.pose import BodyPose

PAPER = (251, 250, 247)
"""The colour that everything stands on; report.html's."""
AROUND_M = 0.15
"""How far beyond the skin there may be clothes and hair."""
NEAR_M = 0.05


@dataclass(frozen=True, eq=False, kw_only=True)
class Look:
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

    def camera(self, height_px: int) -> Camera:
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


def drawn(
    avatar: Avatar, body: ShapedBody, patches: SkinPatches, pose: BodyPose, camera: Camera,
    *, cells: WarpCells,
) -> UInt8[np.ndarray, "height width 3"]:  # fmt: skip
    """The avatar on paper. Only the part of the picture that its body covers is rendered.

    Args:
        avatar: Who, as learnt so far.
        body: The same person's body, and
        patches: its skin: they say where in the picture to look.
        pose: In the camera's world.
        camera: Also says how large the picture is.
        cells: The pose's warp.
    """
    width, height = camera.size_px
    picture = np.empty((height, width, 3), dtype=np.uint8)
    picture[:] = PAPER
    left, top, right, bottom = _covered(body, patches, pose, camera)
    if right <= left or bottom <= top:
        return picture
    window = replace(
        camera,
        center_px=(camera.center_px[0] - left, camera.center_px[1] - top),
        size_px=(right - left, bottom - top),
    )
    rgba = render(avatar, pose, window, cells=cells)
    mixed = rgba[..., :3] * 255.0 + (1.0 - rgba[..., 3:]) * np.array(PAPER, dtype=np.float32)
    picture[top:bottom, left:right] = np.clip(mixed + 0.5, 0.0, 255.0).astype(np.uint8)
    return picture


def _covered(
    body: ShapedBody, patches: SkinPatches, pose: BodyPose, camera: Camera
) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of what the person may cover; all of it if part is too near."""
    width, height = camera.size_px
    points, _ = posed(patches, body.with_pose(pose).world_from_rest())
    depth = points @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
    if depth.max() < -AROUND_M:
        return 0, 0, 0, 0
    nearest = float(depth.min()) - AROUND_M
    if nearest < NEAR_M:
        return 0, 0, width, height
    margin = AROUND_M * max(camera.focal_px) / nearest
    places = camera.project(points)
    left, top = np.floor(places.min(axis=0) - margin).astype(int)
    right, bottom = np.ceil(places.max(axis=0) + margin).astype(int)
    return max(0, int(left)), max(0, int(top)), min(width, int(right)), min(height, int(bottom))

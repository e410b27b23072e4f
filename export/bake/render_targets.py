"""Ray samples and target colors for brick fine-tuning."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float32, Int64

from avatar.rig import Rig
from capture.camera import Camera
from export.package.player_tables import PlayerTables
from export.package.render_settings import RenderSettings
from export.picture_difference import picture_on_white
from export.reference.compositor import VoxelCodes, composite_segments
from export.reference.ray_segments import RaySegments
from export.reference.reference_player import PlayerInputs, TracedPicture, trace_picture
from preprocess.body.body_pose import BodyPose

MAX_SEGMENTS = 1_600_000
"""Add no picture beyond this number of segments; rays through fog have many."""

PosedView = tuple[BodyPose, Camera]
"""A pose and a camera that looks at it."""
RgbaPicture = Float32[np.ndarray, "height width 4"]
"""Premultiplied RGBA in [0, 1]."""
RenderFunction = Callable[[BodyPose, Camera], RgbaPicture]
"""Renders the exact picture of the avatar."""


@final
class PictureCache:
    """A renderer that draws each pose and camera once; several tiers look at the same pictures."""

    def __init__(self, renderer: RenderFunction) -> None:
        """Draw nothing yet."""
        self._renderer = renderer
        self._drawn: list[tuple[BodyPose, Camera, RgbaPicture]] = []

    def __call__(self, pose: BodyPose, camera: Camera) -> RgbaPicture:
        """Return the picture of this very pose and camera, objects compared by identity."""
        for known_pose, known_camera, picture in self._drawn:
            if known_pose is pose and known_camera is camera:
                return picture
        picture = self._renderer(pose, camera)
        self._drawn.append((pose, camera, picture))
        return picture


@dataclass(frozen=True, eq=False, kw_only=True)
class RenderTargets:
    """Several pictures as one list of rays.

    Attributes:
        segments: Where the player samples.
        target_colors: The renderer's premultiplied RGBA at the same pixels.
        picture_offsets: First ray of each picture, and the number of rays.
        pixels: Pixels of each picture, covered or not.
        uncovered_error: Squared error on white, for each picture, of pixels without a ray.
    """

    segments: RaySegments
    target_colors: Float32[np.ndarray, "rays 4"]
    picture_offsets: Int64[np.ndarray, "pictures_and_one"]
    pixels: Int64[np.ndarray, "pictures"]
    uncovered_error: Float32[np.ndarray, "pictures"]

    def psnr(self, tables: PlayerTables, settings: RenderSettings, codes: VoxelCodes) -> float:
        """Return the mean PSNR of the player's pictures to the renderer's on white, dB."""
        out = composite_segments(self.segments, settings, tables.bricks, codes)
        error = (picture_on_white(out) - picture_on_white(self.target_colors)) ** 2
        per_ray = np.concatenate([[0.0], np.cumsum(error.sum(axis=1), dtype=np.float64)])
        squares = np.diff(per_ray[self.picture_offsets]) + self.uncovered_error
        return float(np.mean(-10.0 * np.log10(squares / (3.0 * self.pixels) + 1e-10)))


@dataclass(frozen=True, eq=False, kw_only=True)
class TargetBuilder:
    """Draws views with the renderer while the player's rays are traced beside it.

    Attributes:
        tables: As baked.
        codes: Voxel codes of the tables' bricks.
        rig: What moves them.
        renderer: Called on the caller's thread alone.
        executor: Traces the player's rays meanwhile.
        on_picture: Called after each picture.
    """

    tables: PlayerTables
    codes: VoxelCodes
    rig: Rig
    renderer: RenderFunction
    executor: Executor
    on_picture: Callable[[], None]

    def build(self, views: Sequence[PosedView], settings: RenderSettings) -> RenderTargets:
        """Draw the views, or the first of them that reach `MAX_SEGMENTS`."""
        parts = list[tuple[TracedPicture, RgbaPicture]]()
        for pose, camera in views:
            traced = self.executor.submit(self._trace, settings, pose, camera)
            picture = self.renderer(pose, camera)
            parts.append((traced.result(), picture))
            self.on_picture()
            if sum(len(traced.segments.step_m) for traced, _ in parts) > MAX_SEGMENTS:
                break
        return _join_targets(parts)

    def psnr(self, targets: RenderTargets, settings: RenderSettings) -> float:
        """Return the PSNR as baked, dB, with the settings that the targets were built for."""
        return targets.psnr(self.tables, settings, self.codes)

    def _trace(self, settings: RenderSettings, pose: BodyPose, camera: Camera) -> TracedPicture:
        camera_from_body = camera.camera_from_world @ self.rig.world_from_body(pose)
        bones = camera_from_body @ self.rig.body_from_canonical(pose.joint_rotations)
        inputs = PlayerInputs(
            bones=bones[:, :3].astype(np.float32),
            focal=np.array(camera.focal_px, dtype=np.float32),
            center=np.array(camera.center_px, dtype=np.float32),
            size_px=camera.size_px,
            samples=settings.samples,
        )
        return trace_picture(self.tables, self.codes, settings, inputs)


def _join_targets(parts: Sequence[tuple[TracedPicture, RgbaPicture]]) -> RenderTargets:
    target_colors, uncovered_error = [], []
    for traced, picture in parts:
        colors = picture.reshape(-1, 4)
        error = (picture_on_white(colors) - 1.0) ** 2
        error[traced.pixel] = 0.0
        target_colors.append(colors[traced.pixel])
        uncovered_error.append(error.sum(dtype=np.float64))
    return RenderTargets(
        segments=RaySegments.concatenate([traced.segments for traced, _ in parts]),
        target_colors=np.concatenate(target_colors),
        picture_offsets=np.cumsum([0, *(len(traced.pixel) for traced, _ in parts)]),
        pixels=np.array([picture[..., 0].size for _, picture in parts]),
        uncovered_error=np.array(uncovered_error, dtype=np.float32),
    )

"""What the player would show of poses that the renderer has drawn, whatever its bricks hold."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int64

from avatar.deformation.rig import Rig
from capture.camera import Camera
from export.package.player_tables import PlayerTables
from export.package.render_settings import RenderSettings
from export.reference.ray_segments import RaySegments
from export.reference.reference_march import CanonicalRays, PosedNodes
from export.reference.reference_player import PlayerInputs, trace_picture
from export.reference.sirt_kernels import composite_segments
from preprocess.body.body_pose import BodyPose

MAX_SEGMENTS = 1_600_000
"""No more pictures are learnt from when there are so many: through fog fewer of them are enough."""

PosedView = tuple[BodyPose, Camera]
"""A pose and a camera that looks at it."""
RgbaPicture = Float32[np.ndarray, "height width 4"]
RenderFunction = Callable[[BodyPose, Camera], RgbaPicture]
"""The exact picture of the avatar: premultiplied RGBA in [0, 1]."""


class VoxelCodes(NamedTuple):
    """Codes of every brick's own voxels, the empty brick's first, before they are rounded."""

    density: Float32[np.ndarray, "voxels"]
    color: Float32[np.ndarray, "voxels 3"]


@dataclass(frozen=True, eq=False, kw_only=True)
class RenderTargets:
    """Pictures as rays.

    Attributes:
        pieces: Where the player samples.
        wanted: What the renderer shows there.
        pictures: For each picture its first ray, and the end.
        pixels: How many pixels each picture has.
        missed: Of each, the squared error on white of pixels that the player leaves empty.
    """

    segments: RaySegments
    target_colors: Float32[np.ndarray, "rays 4"]
    picture_offsets: Int64[np.ndarray, "pictures_and_one"]
    pixels: Int64[np.ndarray, "picture_offsets"]
    uncovered_error: Float32[np.ndarray, "picture_offsets"]

    def psnr(self, tables: PlayerTables, rules: RenderSettings, codes: VoxelCodes) -> float:
        """Of the player's pictures on white to the renderer's, dB, mean over pictures."""
        out = composite_segments(self.segments, rules, tables.bricks.index, *codes)
        error = (_rays_on_white(out) - _rays_on_white(self.target_colors)) ** 2
        per_ray = np.concatenate([[0.0], np.cumsum(error.sum(axis=1), dtype=np.float64)])
        squares = (
            per_ray[self.picture_offsets[1:]]
            - per_ray[self.picture_offsets[:-1]]
            + self.uncovered_error
        )
        return float(np.mean(-10.0 * np.log10(squares / (3.0 * self.pixels) + 1e-10)))


@dataclass(frozen=True, eq=False, kw_only=True)
class TargetBuilder:
    """Looks at an avatar twice: as the renderer draws it, and as the player follows its rays.

    Attributes:
        tables, codes: As baked.
        rig: What moves them.
        renderer: Asked on the caller's thread alone.
        beside: Where the player's rays are followed meanwhile.
        told: Called after each picture.
    """

    tables: PlayerTables
    codes: VoxelCodes
    rig: Rig
    renderer: RenderFunction
    executor: Executor
    on_picture: Callable[[], None]

    def build(self, views: Sequence[PosedView], rules: RenderSettings) -> RenderTargets:
        """Some views, or the first ones of them if they make too many rays."""
        parts = []
        for pose, camera in views:
            traced = self.executor.submit(
                _trace_view, self.tables, self.codes, self.rig, rules, pose, camera
            )
            picture = self.renderer(pose, camera)
            parts.append((*traced.result(), picture))
            self.on_picture()
            if sum(len(pieces.step_m) for _, pieces, _ in parts) > MAX_SEGMENTS:
                break
        return _join_targets(parts)

    def psnr(self, seen: RenderTargets, rules: RenderSettings) -> float:
        """As baked, drawn by the rules with which it was looked at."""
        return seen.psnr(self.tables, rules, self.codes)


def _trace_view(
    tables: PlayerTables,
    codes: VoxelCodes,
    rig: Rig,
    rules: RenderSettings,
    pose: BodyPose,
    camera: Camera,
) -> tuple[Int64[np.ndarray, "rays"], RaySegments]:
    """Numbers of the covered pixels, and the player's samples on their rays."""
    camera_from_body = camera.camera_from_world @ rig.world_from_body(pose)
    bones = camera_from_body @ rig.body_from_canonical(pose.joint_rotations)
    shot = PlayerInputs(
        bones=bones[:, :3].astype(np.float32),
        focal=np.array(camera.focal_px, dtype=np.float32),
        center=np.array(camera.center_px, dtype=np.float32),
        size_px=camera.size_px,
        samples=rules.samples,
    )
    bricks, pieces = tables.bricks, list[RaySegments]()

    def marched(nodes: PosedNodes, rays: CanonicalRays) -> Float32[np.ndarray, "rays 4"]:
        pieces.append(RaySegments.of_first_layer(rays, nodes, bricks, rules))
        return composite_segments(pieces[0], rules, bricks.index, *codes)

    look = trace_picture(tables, rules, shot, marched)
    whole = pieces[0]
    for number in range(1, rules.layers):
        whole = whole.append_layer(RaySegments.of_further_layer(look, number, bricks, rules))
    return look.pixel, whole


def _join_targets(
    parts: Sequence[tuple[Int64[np.ndarray, "_"], RaySegments, RgbaPicture]],
) -> RenderTargets:
    wanted, missed = [], []
    for pixel, _, picture in parts:
        colors = picture.reshape(-1, 4)
        left = (_rays_on_white(colors) - 1.0) ** 2
        left[pixel] = 0.0
        wanted.append(colors[pixel])
        missed.append(left.sum(dtype=np.float64))
    return RenderTargets(
        segments=RaySegments.concatenate([pieces for _, pieces, _ in parts]),
        target_colors=np.concatenate(wanted),
        picture_offsets=np.cumsum([0, *(len(pixel) for pixel, _, _ in parts)]),
        pixels=np.array([picture[..., 0].size for *_, picture in parts]),
        uncovered_error=np.array(missed, dtype=np.float32),
    )


def _rays_on_white(colors: Float32[np.ndarray, "rays 4"]) -> Float32[np.ndarray, "rays 3"]:
    return np.clip(colors[:, :3] + (1.0 - colors[:, 3:]), 0.0, 1.0)

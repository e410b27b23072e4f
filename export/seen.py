"""What the player would show of poses that the renderer has drawn, whatever its bricks hold."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int64

from avatar.rig import Rig
from capture.camera import Camera
from export.descent import shown
from export.pieces import Pieces
from export.rules import DrawingRules
from export.tables import Tables
from export.twin import Shot, look_at
from export.twin_march import PosedNodes, Rays
from preprocess.pose import BodyPose

MOST_PIECES = 1_600_000
"""No more pictures are learnt from when there are so many: through fog fewer of them are enough."""

View = tuple[BodyPose, Camera]
"""A pose and a camera that looks at it."""
Picture = Float32[np.ndarray, "height width 4"]
Renderer = Callable[[BodyPose, Camera], Picture]
"""The exact picture of the avatar: premultiplied RGBA in [0, 1]."""


class Codes(NamedTuple):
    """Codes of every brick's own voxels, the empty brick's first, before they are rounded."""

    density: Float32[np.ndarray, "voxels"]
    color: Float32[np.ndarray, "voxels 3"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Seen:
    """Pictures as rays.

    Attributes:
        pieces: Where the player samples.
        wanted: What the renderer shows there.
        pictures: For each picture its first ray, and the end.
        pixels: How many pixels each picture has.
        missed: Of each, the squared error on white of pixels that the player leaves empty.
    """

    pieces: Pieces
    wanted: Float32[np.ndarray, "rays 4"]
    pictures: Int64[np.ndarray, "pictures_and_one"]
    pixels: Int64[np.ndarray, "pictures"]
    missed: Float32[np.ndarray, "pictures"]

    def psnr(self, tables: Tables, rules: DrawingRules, codes: Codes) -> float:
        """Of the player's pictures on white to the renderer's, dB, mean over pictures."""
        out = shown(self.pieces, rules, tables.bricks.index, *codes)
        error = (_on_white(out) - _on_white(self.wanted)) ** 2
        per_ray = np.concatenate([[0.0], np.cumsum(error.sum(axis=1), dtype=np.float64)])
        squares = per_ray[self.pictures[1:]] - per_ray[self.pictures[:-1]] + self.missed
        return float(np.mean(-10.0 * np.log10(squares / (3.0 * self.pixels) + 1e-10)))


@dataclass(frozen=True, eq=False, kw_only=True)
class Onlooker:
    """Looks at an avatar twice: as the renderer draws it, and as the player follows its rays.

    Attributes:
        tables, codes: As baked.
        rig: What moves them.
        renderer: Asked on the caller's thread alone.
        beside: Where the player's rays are followed meanwhile.
        told: Called after each picture.
    """

    tables: Tables
    codes: Codes
    rig: Rig
    renderer: Renderer
    beside: Executor
    told: Callable[[], None]

    def looked(self, views: Sequence[View], rules: DrawingRules) -> Seen:
        """Some views, or the first ones of them if they make too many rays."""
        parts = []
        for pose, camera in views:
            traced = self.beside.submit(
                _traced, self.tables, self.codes, self.rig, rules, pose, camera
            )
            picture = self.renderer(pose, camera)
            parts.append((*traced.result(), picture))
            self.told()
            if sum(len(pieces.step_m) for _, pieces, _ in parts) > MOST_PIECES:
                break
        return _seen(parts)

    def psnr(self, seen: Seen, rules: DrawingRules) -> float:
        """As baked, drawn by the rules with which it was looked at."""
        return seen.psnr(self.tables, rules, self.codes)


def _traced(
    tables: Tables, codes: Codes, rig: Rig, rules: DrawingRules, pose: BodyPose, camera: Camera
) -> tuple[Int64[np.ndarray, "rays"], Pieces]:
    """Numbers of the covered pixels, and the player's samples on their rays."""
    camera_from_body = camera.camera_from_world @ rig.world_from_body(pose)
    bones = camera_from_body @ rig.body_from_canonical(pose.joint_rotations)
    shot = Shot(
        bones=bones[:, :3].astype(np.float32),
        focal=np.array(camera.focal_px, dtype=np.float32),
        center=np.array(camera.center_px, dtype=np.float32),
        size_px=camera.size_px,
        samples=rules.samples,
    )
    bricks, pieces = tables.bricks, list[Pieces]()

    def marched(nodes: PosedNodes, rays: Rays) -> Float32[np.ndarray, "rays 4"]:
        pieces.append(Pieces.of_first(rays, nodes, bricks, rules))
        return shown(pieces[0], rules, bricks.index, *codes)

    look = look_at(tables, rules, shot, marched)
    whole = pieces[0]
    for number in range(1, rules.layers):
        whole = whole.followed_by(Pieces.behind(look, number, bricks, rules))
    return look.pixel, whole


def _seen(parts: Sequence[tuple[Int64[np.ndarray, "_"], Pieces, Picture]]) -> Seen:
    wanted, missed = [], []
    for pixel, _, picture in parts:
        colors = picture.reshape(-1, 4)
        left = (_on_white(colors) - 1.0) ** 2
        left[pixel] = 0.0
        wanted.append(colors[pixel])
        missed.append(left.sum(dtype=np.float64))
    return Seen(
        pieces=Pieces.joined([pieces for _, pieces, _ in parts]),
        wanted=np.concatenate(wanted),
        pictures=np.cumsum([0, *(len(pixel) for pixel, _, _ in parts)]),
        pixels=np.array([picture[..., 0].size for *_, picture in parts]),
        missed=np.array(missed, dtype=np.float32),
    )


def _on_white(colors: Float32[np.ndarray, "rays 4"]) -> Float32[np.ndarray, "rays 3"]:
    return np.clip(colors[:, :3] + (1.0 - colors[:, 3:]), 0.0, 1.0)

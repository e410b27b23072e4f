"""Bricks fine-tuned until the player's pixels are what the volume renderer shows.

A voxel that holds the field's value at its place is not the voxel with which a few samples, linear
between voxels and rounded, look most like the field. Rays of the player are compared with the same
rays of the renderer, and each shares its error among the voxels that it has read.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64
from scipy.spatial.transform import Rotation

from avatar.rig import Rig
from capture.camera import Camera
from export.codec import with_borders
from export.descent import pushed, shown
from export.pieces import Pieces
from export.rules import DrawingRules
from export.tables import BRICK, COLOR_STEP, DENSITY_STEP, Bricks, Tables, rounded
from export.twin import Shot, look_at
from export.twin_march import PosedNodes, Rays
from preprocess.pose import BodyPose

TUNED_PX, JUDGED_PX = 540, 256
"""Longer side of the pictures that bricks are tuned on, and of those that judge."""
ENLARGED = 2
"""No picture is more than so many times as large as the one that was asked for."""
MOST_PIECES = 1_600_000
"""No more pictures are learnt from when there are so many: through fog fewer of them are enough."""
LEAST_GAIN_DB = 0.01
ROUNDS = 4
"""Three quarters of what can be gained come with the first two; more learn the rays by heart."""
COLOR_DAMPING, DENSITY_DAMPING = 0.5, 1e-3
"""A voxel seen by less than half a ray stays nearly as it is; so does one whose density hardly
matters: ten rays that move by a hundredth with every code."""
FARTHEST = 24
"""Codes of density are never farther from the field's than this: twice or half as dense."""
BENT, NOVEL_BENT = 0.05, 0.3
"""Deviation of each joint's turn, radians, in poses to learn from, and in new poses that judge."""
TILTED = 0.2
"""Deviation of the cameras' height, radians about the pelvis."""
NOVEL = 2
"""New poses that judge, besides the views that were given."""
LAYER_GAIN_DB = 0.2
"""One depth layer more is drawn where new poses win this much by it. It costs 3 % of a picture's
time: an actor wins 0.06, a real person learnt from few photographs half a decibel."""

View = tuple[BodyPose, Camera]
"""A pose and a camera that looks at it."""
Picture = Float32[np.ndarray, "height width 4"]
Renderer = Callable[[BodyPose, Camera], Picture]
"""The exact picture of the avatar: premultiplied RGBA in [0, 1]."""
Progress = Callable[[float], None]
"""Told how much of the work is done, from 0 to 1."""


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

    def of_layers(self, count: int) -> "Seen":
        """The same, drawn with so many depth layers."""
        return replace(self, pieces=self.pieces.of_layers(count))

    def psnr(self, tables: Tables, rules: DrawingRules, codes: Codes) -> float:
        """Of the player's pictures on white to the renderer's, dB, mean over pictures."""
        return float(np.mean(self.psnr_of_each(tables, rules, codes)))

    def psnr_of_each(
        self, tables: Tables, rules: DrawingRules, codes: Codes
    ) -> Float64[np.ndarray, "pictures"]:
        """The same of each picture."""
        out = shown(self.pieces, rules, tables.bricks.index, *codes)
        error = (_on_white(out) - _on_white(self.wanted)) ** 2
        per_ray = np.concatenate([[0.0], np.cumsum(error.sum(axis=1), dtype=np.float64)])
        squares = per_ray[self.pictures[1:]] - per_ray[self.pictures[:-1]] + self.missed
        return -10.0 * np.log10(squares / (3.0 * self.pixels) + 1e-10)


@dataclass(frozen=True, eq=False, kw_only=True)
class Tuned:
    """What fine-tuning made.

    Attributes:
        tables: The best that was seen; the given ones if nothing was better.
        rules: How they are drawn: as asked, or with one depth layer more.
        psnr: Of pictures that were not learnt from to the renderer's, dB, before and after; None
            where nothing was tuned.
    """

    tables: Tables
    rules: DrawingRules
    psnr: tuple[float, float] | None


def tuned(
    tables: Tables,
    rig: Rig,
    rules: DrawingRules,
    renderer: Renderer,
    *,
    views: Sequence[View],
    pictures: int,
    beside: Executor,
    progress: Progress = lambda _: None,
) -> Tuned:
    """Bricks with which the player shows more of what the renderer shows.

    Learns from poses near the given ones, seen from all sides. After each round the rounded bricks
    are judged by the given views and by new poses, which no round has seen. Before that the new
    poses say whether one depth layer more is worth its time.

    Args:
        tables: As baked.
        rig: What moves them.
        rules: How they will be drawn, at the least.
        renderer: Asked on this thread alone.
        views: Poses and cameras of the avatar.
        pictures: How many to learn from, at most.
        beside: Where the player's rays are followed meanwhile.
        progress: Told how much is done.
    """
    generator = np.random.default_rng(0)
    learnt = list(_near(views, rig, pictures, BENT, generator, TUNED_PX))
    asked = [(pose, _within(camera, JUDGED_PX)) for pose, camera in views]
    asked += list(_near(views, rig, NOVEL, NOVEL_BENT, generator, JUDGED_PX))
    total = len(learnt) + len(asked) + ROUNDS
    steps = iter(range(1, total + 1))

    codes = _codes(tables.bricks)

    def looked(some: Sequence[View], rules: DrawingRules) -> Seen:
        parts = []
        for pose, camera in some:
            traced = beside.submit(_traced, tables, codes, rig, rules, pose, camera)
            picture = renderer(pose, camera)
            parts.append((*traced.result(), picture))
            progress(next(steps) / total)
            if sum(len(pieces.step_m) for _, pieces, _ in parts) > MOST_PIECES:
                break
        return _seen(parts)

    deeper = replace(rules, layers=rules.layers + 1)
    judge = looked(asked, deeper)
    gain = [
        seen.psnr_of_each(tables, rules, codes)[-NOVEL:].mean()
        for seen in (judge.of_layers(rules.layers), judge)
    ]
    rules = deeper if gain[1] - gain[0] >= LAYER_GAIN_DB else rules
    judge, lesson = judge.of_layers(rules.layers), looked(learnt, rules)
    best, first = codes, judge.psnr(tables, rules, codes)
    score = first
    for latent in _rounds(lesson, tables, rules, codes):
        attempt = _rounded(latent, codes)
        reached = judge.psnr(tables, rules, attempt)
        progress(next(steps) / total)
        if reached < score + LEAST_GAIN_DB:
            break
        best, score = attempt, reached
    if best is codes:
        return Tuned(tables=tables, rules=rules, psnr=(first, first))
    bricks = _bricks(tables.bricks, best)
    return Tuned(tables=replace(tables, bricks=bricks), rules=rules, psnr=(first, score))


def _rounds(lesson: Seen, tables: Tables, rules: DrawingRules, baked: Codes) -> Iterator[Codes]:
    """Codes after each round, as they are before they are rounded."""
    density, color = baked
    low, high = np.maximum(density - FARTHEST, 0.0), np.minimum(density + FARTHEST, 255.0)
    for _ in range(ROUNDS):
        push = pushed(lesson.pieces, rules, tables.bricks.index, density, color, lesson.wanted)
        color = color - push.color / (push.color_share + np.float32(COLOR_DAMPING))[:, None]
        density = density - push.density / (push.density_share + np.float32(DENSITY_DAMPING))
        color, density = np.clip(color, 0.0, 255.0), np.clip(density, low, high)
        color[: BRICK**3], density[: BRICK**3] = 0.0, 0.0  # the empty brick
        yield Codes(density, color)


def _rounded(latent: Codes, baked: Codes) -> Codes:
    """As codes are stored; what was visible stays so."""
    color = rounded(np.round(latent.color).astype(np.uint8), COLOR_STEP, 255)
    density = rounded(np.round(latent.density).astype(np.uint8), DENSITY_STEP, 255)
    density = np.where(baked.density > 0, np.maximum(density, DENSITY_STEP), density)
    return Codes(density.astype(np.float32), color.astype(np.float32))


def _codes(bricks: Bricks) -> Codes:
    core = bricks.voxels[:, :BRICK, :BRICK, :BRICK].reshape(-1, 4).astype(np.float32)
    return Codes(np.ascontiguousarray(core[:, 3]), np.ascontiguousarray(core[:, :3]))


def _bricks(bricks: Bricks, codes: Codes) -> Bricks:
    core = np.concatenate([codes.color, codes.density[:, None]], axis=1).astype(np.uint8)
    shape = (len(bricks.voxels), BRICK, BRICK, BRICK, 4)
    return replace(bricks, voxels=with_borders(bricks.index, core.reshape(shape)))


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


def _near(
    views: Sequence[View],
    rig: Rig,
    count: int,
    bent: float,
    generator: np.random.Generator,
    longest_px: int,
) -> Iterator[View]:
    """Poses near the views' own, each seen from a side of its own."""
    for turn in range(count):
        pose, camera = views[turn % len(views)]
        by = Rotation.from_rotvec(generator.normal(size=(23, 3)) * bent)
        joints = (Rotation.from_rotvec(pose.joint_rotations) * by).as_rotvec()
        pose = replace(pose, joint_rotations=joints)
        root = rig.world_from_body(pose)
        pelvis = root[:3, :3] @ rig.rest_joints[0] + root[:3, 3]
        round_ = Rotation.from_rotvec(root[:3, 1] * generator.uniform(-np.pi, np.pi))
        across = camera.camera_from_world[0, :3]
        orbit = round_ * Rotation.from_rotvec(across * generator.normal() * TILTED)
        moved = np.eye(4)
        moved[:3, :3] = orbit.as_matrix()
        moved[:3, 3] = pelvis - moved[:3, :3] @ pelvis
        camera = replace(camera, camera_from_world=camera.camera_from_world @ moved)
        yield pose, _within(camera, longest_px)


def _within(camera: Camera, longest_px: int) -> Camera:
    return camera.fitted(min(longest_px, ENLARGED * max(camera.size_px)))


def _on_white(colors: Float32[np.ndarray, "rays 4"]) -> Float32[np.ndarray, "rays 3"]:
    return np.clip(colors[:, :3] + (1.0 - colors[:, 3:]), 0.0, 1.0)

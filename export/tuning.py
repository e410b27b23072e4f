"""Bricks fine-tuned until the player's pixels are what the volume renderer shows.

A voxel that holds the field's value at its place is not the voxel with which a few samples, linear
between voxels and rounded, look most like the field. Rays of the player are compared with the same
rays of the renderer, and each shares its error among the voxels that it has read.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from avatar.rig import Rig
from capture.camera import Camera
from export.codec import with_borders
from export.descent import pushed
from export.rules import DrawingRules
from export.seen import Codes, Onlooker, Renderer, Seen, View
from export.tables import BRICK, COLOR_STEP, DENSITY_STEP, Bricks, Tables, rounded

TUNED_PX, JUDGED_PX = 540, 256
"""Longer side of the pictures that bricks are tuned on, and of those that judge."""
ENLARGED = 2
"""No picture is more than so many times as large as the one that was asked for."""
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
WANTED_DB = 39.0
"""Where the player is farther from the renderer than this in poses as filmed, voxels are finer, and
more of what lies behind the first depth layer is drawn, if new poses win by it."""
NEAR = 6
"""Pictures that say how much it shows, of poses near the given ones."""
DEEPER = {"layers": 3, "sheet_gap_m": -0.015}
"""6 % of a picture's time. Where limbs touch it wins a decibel and more."""
LEAST_DEEPER_GAIN_DB = 0.2

Progress = Callable[[float], None]
"""Told how much of the work is done, from 0 to 1."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Tuned:
    """What fine-tuning made.

    Attributes:
        tables: The best that was seen; the given ones if nothing was better.
        rules: How they are drawn: as asked, or with more behind the first depth layer.
        psnr: Of pictures that were not learnt from to the renderer's, dB, before and after; None
            where nothing was tuned.
    """

    tables: Tables
    rules: DrawingRules
    psnr: tuple[float, float] | None


def far_off(
    tables: Tables,
    rig: Rig,
    rules: DrawingRules,
    renderer: Renderer,
    *,
    views: Sequence[View],
    beside: Executor,
) -> bool:
    """Whether the player is farther from the renderer than is wanted, as baked. As for `tuned`."""
    onlooker = Onlooker(
        tables=tables, codes=_codes(tables.bricks), rig=rig, renderer=renderer, beside=beside,
        told=lambda: None,
    )  # fmt: skip
    near = list(_near(views, rig, NEAR, BENT, np.random.default_rng(1), JUDGED_PX))
    return onlooker.psnr(onlooker.looked(near, rules), rules) < WANTED_DB


def tuned(
    tables: Tables,
    rig: Rig,
    rules: DrawingRules,
    renderer: Renderer,
    *,
    views: Sequence[View],
    pictures: int,
    beside: Executor,
    deepens: bool = False,
    progress: Progress = lambda _: None,
) -> Tuned:
    """Bricks with which the player shows more of what the renderer shows.

    Learns from poses near the given ones, seen from all sides. After each round the rounded bricks
    are judged by the given views and by new poses, which no round has seen.

    Args:
        tables: As baked.
        rig: What moves them.
        rules: How they will be drawn, at the least.
        renderer: Asked on this thread alone.
        views: Poses and cameras of the avatar.
        pictures: How many to learn from, at most.
        beside: Where the player's rays are followed meanwhile.
        deepens: Whether more of what lies behind is drawn if new poses win by it.
        progress: Told how much is done.
    """
    generator = np.random.default_rng(0)
    learnt = list(_near(views, rig, pictures, BENT, generator, TUNED_PX))
    asked = [(pose, _within(camera, JUDGED_PX)) for pose, camera in views]
    asked += list(_near(views, rig, NOVEL, NOVEL_BENT, generator, JUDGED_PX))
    total = len(learnt) + len(asked) + 2 * NOVEL + ROUNDS
    steps, codes = iter(range(1, total + 1)), _codes(tables.bricks)
    onlooker = Onlooker(
        tables=tables, codes=codes, rig=rig, renderer=renderer, beside=beside,
        told=lambda: progress(next(steps) / total),
    )  # fmt: skip
    rules = _deep_enough(onlooker, rules, asked[-NOVEL:]) if deepens else rules
    judge, lesson = onlooker.looked(asked, rules), onlooker.looked(learnt, rules)
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


def _deep_enough(onlooker: Onlooker, rules: DrawingRules, novel: Sequence[View]) -> DrawingRules:
    """The rules, or those that draw more of what lies behind, if new poses win by it."""
    deeper = replace(rules, **DEEPER)
    before, after = (onlooker.psnr(onlooker.looked(novel, each), each) for each in (rules, deeper))
    return deeper if after >= before + LEAST_DEEPER_GAIN_DB else rules


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

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

from avatar.deformation.rig import Rig
from capture.camera import Camera
from export.bake.render_targets import (
    PosedView,
    RenderFunction,
    RenderTargets,
    TargetBuilder,
)
from export.package.player_tables import (
    BRICK_SIZE,
    COLOR_CODE_STEP,
    DENSITY_CODE_STEP,
    BrickTable,
    PlayerTables,
    round_codes,
)
from export.package.render_settings import RenderSettings
from export.package.table_codec import add_border_voxels
from export.reference.compositor import VoxelCodes, back_project

TRAINING_PX, VALIDATION_PX = 540, 256
"""Longer side of the pictures that bricks are tuned on, and of those that judge."""
MAX_UPSCALE = 2
"""No picture is more than so many times as large as the one that was asked for."""
MIN_GAIN_DB = 0.01
ROUNDS = 4
"""Three quarters of what can be gained come with the first two; more learn the rays by heart."""
COLOR_DAMPING, DENSITY_DAMPING = 0.5, 1e-3
"""A voxel seen by less than half a ray stays nearly as it is; so does one whose density hardly
matters: ten rays that move by a hundredth with every code."""
MAX_DENSITY_CODE_CHANGE = 24
"""Codes of density are never farther from the field's than this: twice or half as dense."""
POSE_NOISE_RAD, NOVEL_POSE_NOISE_RAD = 0.05, 0.3
"""Deviation of each joint's turn, radians, in poses to learn from, and in new poses that judge."""
CAMERA_TILT_RAD = 0.2
"""Deviation of the cameras' height, radians about the pelvis."""
NOVEL_POSES = 2
"""New poses that judge, besides the views that were given."""
TARGET_DB = 39.0
"""Where the player is farther from the renderer than this in poses as filmed, voxels are finer, and
more of what lies behind the first depth layer is drawn, if new poses win by it."""
PROBE_PICTURES = 6
"""Pictures that say how much it shows, of poses near the given ones."""
DEEPER_SETTINGS = {"layers": 3, "other_sheet_gap_m": -0.015}
"""6 % of a picture's time. Where limbs touch it wins a decibel and more."""
MIN_DEEPER_GAIN_DB = 0.2

ExportProgress = Callable[[float], None]
"""Told how much of the work is done, from 0 to 1."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FineTuningResult:
    """What fine-tuning made.

    Attributes:
        tables: The best that was seen; the given ones if nothing was better.
        settings: How they are drawn: as asked, or with more behind the first depth layer.
        psnr: Of pictures that were not learnt from to the renderer's, dB, before and after; None
            where nothing was tuned.
    """

    tables: PlayerTables
    settings: RenderSettings
    psnr: tuple[float, float] | None


def is_below_target(
    tables: PlayerTables,
    rig: Rig,
    settings: RenderSettings,
    renderer: RenderFunction,
    *,
    views: Sequence[PosedView],
    executor: Executor,
) -> bool:
    """Whether the player is farther from the renderer than is wanted, as baked. As for `tuned`."""
    onlooker = TargetBuilder(
        tables=tables, codes=VoxelCodes.of(tables.bricks), rig=rig, renderer=renderer, executor=executor,
        on_picture=lambda: None,
    )  # fmt: skip
    near = list(
        _perturbed_views(
            views, rig, PROBE_PICTURES, POSE_NOISE_RAD, np.random.default_rng(1), VALIDATION_PX
        )
    )
    return onlooker.psnr(onlooker.build(near, settings), settings) < TARGET_DB


def fine_tune(
    tables: PlayerTables,
    rig: Rig,
    settings: RenderSettings,
    renderer: RenderFunction,
    *,
    views: Sequence[PosedView],
    max_pictures: int,
    executor: Executor,
    may_add_layers: bool = False,
    progress: ExportProgress = lambda _: None,
) -> FineTuningResult:
    """Bricks with which the player shows more of what the renderer shows.

    Learns from poses near the given ones, seen from all sides. After each round the rounded bricks
    are judged by the given views and by new poses, which no round has seen.

    Args:
        tables: As baked.
        rig: What moves them.
        settings: How they will be drawn, at the least.
        renderer: Asked on this thread alone.
        views: Poses and cameras of the avatar.
        pictures: How many to learn from, at most.
        beside: Where the player's rays are followed meanwhile.
        deepens: Whether more of what lies behind is drawn if new poses win by it.
        progress: Told how much is done.
    """
    generator = np.random.default_rng(0)
    learnt = list(
        _perturbed_views(views, rig, max_pictures, POSE_NOISE_RAD, generator, TRAINING_PX)
    )
    asked = [(pose, _fit_camera(camera, VALIDATION_PX)) for pose, camera in views]
    asked += list(
        _perturbed_views(views, rig, NOVEL_POSES, NOVEL_POSE_NOISE_RAD, generator, VALIDATION_PX)
    )
    total = len(learnt) + len(asked) + 2 * NOVEL_POSES + ROUNDS
    steps, codes = iter(range(1, total + 1)), VoxelCodes.of(tables.bricks)
    onlooker = TargetBuilder(
        tables=tables, codes=codes, rig=rig, renderer=renderer, executor=executor,
        on_picture=lambda: progress(next(steps) / total),
    )  # fmt: skip
    settings = (
        _choose_layers(onlooker, settings, asked[-NOVEL_POSES:]) if may_add_layers else settings
    )
    judge, lesson = onlooker.build(asked, settings), onlooker.build(learnt, settings)
    best, first = codes, judge.psnr(tables, settings, codes)
    score = first
    for latent in _sirt_rounds(lesson, tables, settings, codes):
        attempt = _quantize_codes(latent, codes)
        reached = judge.psnr(tables, settings, attempt)
        progress(next(steps) / total)
        if reached < score + MIN_GAIN_DB:
            break
        best, score = attempt, reached
    if best is codes:
        return FineTuningResult(tables=tables, settings=settings, psnr=(first, first))
    bricks = _bricks_from_codes(tables.bricks, best)
    return FineTuningResult(
        tables=replace(tables, bricks=bricks), settings=settings, psnr=(first, score)
    )


def _choose_layers(
    onlooker: TargetBuilder, settings: RenderSettings, novel: Sequence[PosedView]
) -> RenderSettings:
    """The settings, or those that draw more of what lies behind, if new poses win by it."""
    deeper = replace(settings, **DEEPER_SETTINGS)
    before, after = (
        onlooker.psnr(onlooker.build(novel, each), each) for each in (settings, deeper)
    )
    return deeper if after >= before + MIN_DEEPER_GAIN_DB else settings


def _sirt_rounds(
    targets: RenderTargets, tables: PlayerTables, settings: RenderSettings, baked: VoxelCodes
) -> Iterator[VoxelCodes]:
    """Codes after each round, as they are before they are rounded."""
    codes, density = baked, baked.density
    low, high = (
        np.maximum(density - MAX_DENSITY_CODE_CHANGE, 0.0),
        np.minimum(density + MAX_DENSITY_CODE_CHANGE, 255.0),
    )
    for _ in range(ROUNDS):
        update = back_project(
            targets.segments, settings, tables.bricks, codes, targets.target_colors
        )
        color_step = update.color / (update.color_normalizer + np.float32(COLOR_DAMPING))[:, None]
        density_step = update.density / (update.density_normalizer + np.float32(DENSITY_DAMPING))
        color, density = codes.color - color_step, codes.density - density_step
        color, density = np.clip(color, 0.0, 255.0), np.clip(density, low, high)
        color[: BRICK_SIZE**3], density[: BRICK_SIZE**3] = 0.0, 0.0  # the empty brick
        codes = VoxelCodes(density, color)
        yield codes


def _quantize_codes(latent: VoxelCodes, baked: VoxelCodes) -> VoxelCodes:
    """As codes are stored; what was visible stays so."""
    color = round_codes(np.round(latent.color).astype(np.uint8), COLOR_CODE_STEP, 255)
    density = round_codes(np.round(latent.density).astype(np.uint8), DENSITY_CODE_STEP, 255)
    density = np.where(baked.density > 0, np.maximum(density, DENSITY_CODE_STEP), density)
    return VoxelCodes(density.astype(np.float32), color.astype(np.float32))


def _bricks_from_codes(bricks: BrickTable, codes: VoxelCodes) -> BrickTable:
    core = np.concatenate([codes.color, codes.density[:, None]], axis=1).astype(np.uint8)
    shape = (len(bricks.voxels), BRICK_SIZE, BRICK_SIZE, BRICK_SIZE, 4)
    return replace(bricks, voxels=add_border_voxels(bricks.index, core.reshape(shape)))


def _perturbed_views(
    views: Sequence[PosedView],
    rig: Rig,
    count: int,
    pose_noise_rad: float,
    generator: np.random.Generator,
    longest_px: int,
) -> Iterator[PosedView]:
    """Poses near the views' own, each seen from a side of its own."""
    for turn in range(count):
        pose, camera = views[turn % len(views)]
        by = Rotation.from_rotvec(generator.normal(size=(23, 3)) * pose_noise_rad)
        joints = (Rotation.from_rotvec(pose.joint_rotations) * by).as_rotvec()
        pose = replace(pose, joint_rotations=joints)
        root = rig.world_from_body(pose)
        pelvis = root[:3, :3] @ rig.rest_joints[0] + root[:3, 3]
        round_ = Rotation.from_rotvec(root[:3, 1] * generator.uniform(-np.pi, np.pi))
        across = camera.camera_from_world[0, :3]
        orbit = round_ * Rotation.from_rotvec(across * generator.normal() * CAMERA_TILT_RAD)
        moved = np.eye(4)
        moved[:3, :3] = orbit.as_matrix()
        moved[:3, 3] = pelvis - moved[:3, :3] @ pelvis
        camera = replace(camera, camera_from_world=camera.camera_from_world @ moved)
        yield pose, _fit_camera(camera, longest_px)


def _fit_camera(camera: Camera, longest_px: int) -> Camera:
    return camera.resize_longer_side(min(longest_px, MAX_UPSCALE * max(camera.size_px)))

"""Fine-tuning of bricks until the player's pixels show what the volume renderer shows.

Sampled a few times, interpolated and quantized, voxels that hold the field's values at their nodes
are not the ones that look most like the field. Rays of the player are compared with the
same rays of the renderer, and each shares its error among the voxels that it has read (SIRT).
Voxels that hardly show then share codes (`voxel_cells`), and the shared codes are tuned again.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Int64
from scipy.spatial.transform import Rotation

from avatar.rig import Rig
from capture.camera import Camera
from export.bake.compositor import SirtUpdate, VoxelCodes, back_project, composite_segments
from export.bake.traced_rays import RaySegments, RayTracer, TracedPicture
from export.bake.voxel_cells import (
    VoxelCells,
    brick_chunks,
    quantize_bricks,
    share_codes_within_budget,
)
from export.package.player_tables import BRICK_SIZE, BrickTable, PlayerTables, RenderSettings
from export.player import picture_on_white
from export.player_inputs import fit_camera
from preprocess.body.body_pose import BodyPose

PosedView = tuple[BodyPose, Camera]
"""A pose and a camera that looks at it."""
RgbaPicture = Float32[np.ndarray, "height width 4"]
"""Premultiplied RGBA in [0, 1]."""
RenderFunction = Callable[[BodyPose, Camera], RgbaPicture]
"""Renders the exact picture of the avatar."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RenderTargets:
    """Several pictures as one list of rays.

    Attributes:
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


TRAINING_PX = 540
"""Longer side of the pictures that bricks are tuned on, pixels."""
VALIDATION_PX = 256
"""Longer side of the pictures that judge, pixels."""
MAX_UPSCALE = 2
"""Largest factor by which a view's camera is enlarged."""
FREE_ROUNDS = 1
"""SIRT rounds in which each voxel has its own codes; a second gains 0.05 dB."""
SHARED_ROUNDS = 2
"""SIRT rounds in which the voxels of a cell share a code."""
POSE_NOISE_RAD = 0.05
"""Standard deviation of joint rotations about a view's pose in training pictures, radians."""
NOVEL_POSES = 2
"""Novel poses that judge besides the views."""
TARGET_DB = 39.0
"""PSNR to the renderer near the views, dB, below which a field counts as thick: it is drawn with
`THICK_FIELD_TIERS`, and its voxels follow from their bytes."""
THICK_FIELD_PICTURES = 8
"""Pictures on which the bricks of a thick field are tuned, at most: more gain 0.1 dB there, and
each takes twice as long to draw."""
PROBE_PICTURES = 6
"""Pictures near the views that are compared with `TARGET_DB`."""
ExportProgress = Callable[[float], None]
"""Receives the fraction of the work that is done, from 0 to 1."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FineTuningInputs:
    """Baked tables to be fine-tuned, and the views and the renderer to tune them against.

    Attributes:
        settings: Tiers' settings, "hq" among them; rays of all tiers are learnt from, and judge.
        renderer: Renders the exact picture, on the caller's thread alone.
        executor: Traces the player's rays meanwhile, those of the next picture, too.
    """

    tables: PlayerTables
    rig: Rig
    settings: Mapping[str, RenderSettings]
    renderer: RenderFunction
    views: Sequence[PosedView]
    executor: Executor

    @cached_property
    def _tracers(self) -> dict[str, RayTracer]:
        made = self.executor.map(lambda each: RayTracer(self.tables, each), self.settings.values())
        return dict(zip(self.settings, made, strict=True))

    def draw_targets(
        self,
        views: Sequence[PosedView],
        tiers: Sequence[str],
        on_picture: Callable[[], None] = lambda: None,
    ) -> list[RenderTargets]:
        """Draw views with the renderer while the player's rays are traced beside it, for each tier.

        A tier gets all views, or the first of them that reach 1.6 million segments (rays
        through fog have many); `on_picture` is called after each picture.
        """
        drawn = [list[tuple[TracedPicture, RgbaPicture]]() for _ in tiers]
        tracers = [self._tracers[tier] for tier in tiers]
        traces = (
            [self.executor.submit(self._trace, tracer, *view) for tracer in tracers]
            for view in views
        )
        ahead = next(traces, [])
        for pose, camera in views:
            traced, ahead = ahead, next(traces, [])  # no thread waits for the renderer
            waiting = [
                (parts, trace)
                for parts, trace in zip(drawn, traced, strict=True)
                if sum(len(each.segments.step_m) for each, _ in parts) <= 1_600_000
            ]
            if not waiting:
                break
            picture = self.renderer(pose, camera)
            for parts, trace in waiting:
                parts.append((trace.result(), picture))
            on_picture()
        return [_join_targets(parts) for parts in drawn]

    def _trace(self, tracer: RayTracer, pose: BodyPose, camera: Camera) -> TracedPicture:
        camera_from_body = camera.camera_from_world @ self.rig.world_from_body(pose)
        bones = camera_from_body @ self.rig.body_from_canonical(pose.joint_rotations)
        return tracer.trace(bones[:, :3].astype(np.float32), camera)

    def perturbed_views(
        self, count: int, pose_noise_rad: float, generator: np.random.Generator, longest_px: int
    ) -> list[PosedView]:
        """Perturb the views' poses and orbit their cameras to random azimuths.

        Takes the given views in turn; `pose_noise_rad` is the standard deviation of every joint's
        rotation.
        """
        perturbed = list[PosedView]()
        for turn in range(count):
            pose, camera = self.views[turn % len(self.views)]
            noise = Rotation.from_rotvec(generator.normal(size=(23, 3)) * pose_noise_rad)
            joints = (Rotation.from_rotvec(pose.joint_rotations) * noise).as_rotvec()
            pose = replace(pose, joint_rotations=joints)
            root = self.rig.world_from_body(pose)
            pelvis = root[:3, :3] @ self.rig.rest_joints[0] + root[:3, 3]
            azimuth = Rotation.from_rotvec(root[:3, 1] * generator.uniform(-np.pi, np.pi))
            across = camera.camera_from_world[0, :3]
            orbit = azimuth * Rotation.from_rotvec(across * generator.normal() * 0.2)
            moved = np.eye(4)
            moved[:3, :3] = orbit.as_matrix()
            moved[:3, 3] = pelvis - moved[:3, :3] @ pelvis
            camera = replace(camera, camera_from_world=camera.camera_from_world @ moved)
            perturbed.append((pose, fit_camera(camera, longest_px, max_upscale=MAX_UPSCALE)))
        return perturbed


@dataclass(frozen=True, eq=False, kw_only=True)
class FineTuningResult:
    """Outcome of fine-tuning.

    Attributes:
        tables: Tuned; the given ones if tuning would lose more than 0.1 dB.
        psnr: To the renderer before and after, dB, on pictures that were not trained on; None if
            nothing was tuned. The mean over the tiers.
    """

    tables: PlayerTables
    settings: Mapping[str, RenderSettings]
    psnr: tuple[float, float] | None


def is_below_target(inputs: FineTuningInputs) -> bool:
    """Tell whether the player is farther from the renderer than `TARGET_DB`, as baked."""
    near = inputs.perturbed_views(
        PROBE_PICTURES, POSE_NOISE_RAD, np.random.default_rng(1), VALIDATION_PX
    )
    settings, codes = inputs.settings["hq"], VoxelCodes.of(inputs.tables.bricks)
    (targets,) = inputs.draw_targets(near, ["hq"])
    return targets.psnr(inputs.tables, settings, codes) < TARGET_DB


def fine_tune(
    inputs: FineTuningInputs, *, max_pictures: int, progress: ExportProgress = lambda _: None
) -> FineTuningResult:
    """Fine-tune bricks until the player shows more of what the renderer shows.

    Trains on poses near the views, seen from all sides. After each round the quantized bricks are
    judged on the views and on novel poses, which are not trained on.
    """
    tables, generator = inputs.tables, np.random.default_rng(0)
    training = inputs.perturbed_views(max_pictures, POSE_NOISE_RAD, generator, TRAINING_PX)
    novel = inputs.perturbed_views(NOVEL_POSES, 0.3, generator, VALIDATION_PX)
    asked = [
        (pose, fit_camera(camera, VALIDATION_PX, max_upscale=MAX_UPSCALE))
        for pose, camera in inputs.views
    ]
    total = len(training) + len(asked) + len(novel) + FREE_ROUNDS + SHARED_ROUNDS
    steps = iter(range(1, total + 1))
    codes = VoxelCodes.of(tables.bricks)

    def drawn(views: list[PosedView]) -> list[tuple[RenderTargets, RenderSettings]]:
        targets = inputs.draw_targets(
            views, list(inputs.settings), lambda: progress(next(steps) / total)
        )
        return list(zip(targets, inputs.settings.values(), strict=True))

    judges, learnt = drawn(asked + novel), drawn(training)

    def judge(codes: VoxelCodes) -> float:
        return float(np.mean([targets.psnr(tables, each, codes) for targets, each in judges]))

    baked = codes.density.copy()
    first = judge(codes)
    cells = None
    pixels = sum(int(targets.pixels.sum()) for targets, _ in learnt)
    for turn in range(FREE_ROUNDS + SHARED_ROUNDS):
        update = _sirt_round(learnt, tables.bricks, baked, codes, cells, inputs.executor)
        if turn == FREE_ROUNDS - 1:
            squared_error = 3.0 * pixels * 255.0**2 * 10.0 ** (-0.1 * first)  # of channels, 1/255²
            price = 3e-7 * squared_error  # a million such codes are worth what their bytes are
            cells = share_codes_within_budget(
                tables.bricks, codes, update, baked, price, executor=inputs.executor
            )
        del update
        progress(next(steps) / total)
    tuned = quantize_bricks(tables.bricks, codes, baked)
    reached = judge(VoxelCodes.of(tuned))
    if reached < first - 0.1:
        return FineTuningResult(tables=tables, settings=inputs.settings, psnr=(first, first))
    tables = replace(tables, bricks=tuned)
    return FineTuningResult(tables=tables, settings=inputs.settings, psnr=(first, reached))


def _sirt_round(
    learnt: Sequence[tuple[RenderTargets, RenderSettings]],
    bricks: BrickTable,
    baked: Float32[np.ndarray, "voxels"],
    codes: VoxelCodes,
    cells: Sequence[VoxelCells] | None,
    executor: Executor,
) -> SirtUpdate:
    """Lower the squared error of rays, in place and not rounded; return single voxels' update.

    `baked` are the densities' first codes. Voxels of a cell have equal codes; there are `cells` for
    each of the `brick_chunks`, or None.
    """

    def updates(learnt: tuple[RenderTargets, RenderSettings]) -> SirtUpdate:
        targets, settings = learnt
        return back_project(targets.segments, settings, bricks, codes, targets.target_colors)

    update, *others = executor.map(updates, learnt)
    while others:
        update.add(others.pop())
    for number, chunk in enumerate(brick_chunks(len(baked))):
        single, middle = update.chunk(chunk), baked[chunk]
        if cells is not None:
            single = cells[number].sum_update(single)
            middle = cells[number].mean_density(middle)
        _take_step(codes.chunk(chunk), single, middle)
    codes.color[: BRICK_SIZE**3], codes.density[: BRICK_SIZE**3] = 0.0, 0.0  # the empty brick
    return update


def _take_step(
    codes: VoxelCodes, update: SirtUpdate, middle: Float32[np.ndarray, "voxels"]
) -> None:
    """Change codes, in place; densities stay within half and twice `middle`."""
    # a voxel seen by less than half a ray hardly changes
    color_step = update.color / (update.color_normalizer + np.float32(0.5))[:, None]
    # ten rays whose colors change by 0.01 with every code
    density_step = update.density / (update.density_normalizer + np.float32(1e-3))
    low, high = middle - 24, middle + 24
    codes.color[:] = np.clip(codes.color - color_step, 0.0, 255.0)
    codes.density[:] = np.clip(np.clip(codes.density - density_step, low, high), 0.0, 255.0)

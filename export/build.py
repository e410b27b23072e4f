"""Exporting an avatar: sample the field, bake, fine-tune, build the graphs, check, write.

(report,) = export_avatar(avatar, Path("avatar.iavatar"), views=[(pose, camera)], metrics={})

The checks compare a package's player with its rays, composited by a compiled kernel, and with the
volume renderer.

The smallest package needs no avatar: a browser that has drawn it has compiled what draws one.
"""

import io
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image

from avatar.avatar_model import Avatar
from avatar.evaluation.image_metrics import psnr
from avatar.render import render
from avatar.rig import Rig, canonical_rotations
from capture.input_error import InputError
from export.bake.bake_tables import BakeConfig, ExportRefused, bake_tables, sample_field
from export.bake.compositor import draw_traced
from export.bake.fine_tuning import (
    THICK_FIELD_PICTURES,
    ExportProgress,
    FineTuningInputs,
    FineTuningResult,
    PosedView,
    RenderFunction,
    fine_tune,
    is_below_target,
)
from export.bake.proxy_surface import FieldFunction
from export.bake.traced_rays import RayTracer
from export.graph.player_graph import build_graph
from export.package.manifest import LICENCE_NOTE, MAX_GOLDEN_PX, GoldenFrame, Manifest, TierInfo
from export.package.package_file import COARSE_GRAPH, AvatarPackage, PackageWriter, write_package
from export.package.player_tables import (
    BRICK_NODES,
    QUALITY_TIERS,
    THICK_FIELD_TIERS,
    WEIGHT_SCALE,
    BrickTable,
    PlayerTables,
    RenderSettings,
    SkinningGrid,
    SurfelTable,
)
from export.package.table_codec import TableLayout, estimate_brick_bytes
from export.player import (
    MIN_SAME_PSNR,
    PictureDifference,
    Player,
    picture_on_white,
    premultiply,
    straighten,
)
from export.player_inputs import fit_camera
from preprocess.body.kinematics import PARENTS

DRAFT_COARSENESS = 1.5
"""Voxels and surfels of a draft, in those of a checked package: 0.7 core-s instead of 2.1 and half
the bytes for 0.6 dB to the renderer (37.6 instead of 38.2, where the avatar is 25 dB from the
film)."""
INTERRUPTED_WARNING = (
    "Fine-tuning was interrupted: the package holds the bricks as they were baked, and looks about "
    "half a decibel less like the avatar. ia-export does it all again."
)
"""Recorded in the package after Ctrl-C."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ExportReport:
    """Outcome of an export.

    Attributes:
        seconds: Wall time of sampling, baking, checking and writing.
        psnr_to_renderer: Mean over the views, dB, by tier.
        largest_difference: Between the graph and its rays composited by the compiled kernel, in
            1/255.
    """

    path: Path
    bytes: int
    seconds: float
    psnr_to_renderer: Mapping[str, float]
    largest_difference: float
    warnings: tuple[str, ...]


def export_avatar(
    avatar: Avatar,
    path: Path,
    *,
    views: Sequence[PosedView],
    metrics: Mapping[str, Any],
    baked_first: bool = False,
    fine_tune_bricks: bool = True,
    progress: ExportProgress = lambda _: None,
) -> Iterator[ExportReport]:
    """Write an avatar's package; with `baked_first` as it was baked, then again fine-tuned.

    Args:
        path: The `.iavatar` file; replaced atomically if it exists.
        views: Poses and cameras to check it with, at least one; the first is the preview, and the
            first few become golden frames. Lens distortion is ignored.
        metrics: Training metrics, kept in the manifest (JSON).
        fine_tune_bricks: Whether to spend some ten seconds on them.
        progress: Receives the fraction of the export that is done, from 0 to 1, while bricks are
            fine-tuned. A KeyboardInterrupt meanwhile, or from it, ends only the fine-tuning.

    Yields:
        The report of each package, once the file is complete.

    Raises:
        ExportRefused: If there is nothing to draw, or this onnxruntime computes something else.
    """
    config = BakeConfig.for_sample_step(avatar.sample_step_m)
    return export_field(
        avatar.color_and_density_at,
        avatar.rig,
        avatar.rendering_grid().occupied.numpy(),
        path,
        views=views,
        metrics=metrics,
        renderer=lambda pose, camera: render(avatar, pose, camera),
        config=config if fine_tune_bricks else replace(config, fine_tuning_pictures=0),
        baked_first=baked_first,
        progress=progress,
    )


def write_draft(avatar: Avatar, path: Path, view: PosedView) -> None:
    """Write an avatar's package as baked, unchecked, without scores and golden frames.

    It is baked coarser, so that it can be played soonest. `view` is the preview.

    Raises:
        ExportRefused: If there is nothing to draw.
    """
    config = BakeConfig.for_sample_step(avatar.sample_step_m)
    config = replace(
        config,
        voxel_m=DRAFT_COARSENESS * config.voxel_m,
        surfel_spacing_m=DRAFT_COARSENESS * config.surfel_spacing_m,
    )
    occupied = avatar.rendering_grid().occupied.numpy()
    grid = sample_field(avatar.color_and_density_at, avatar.rig, occupied=occupied, config=config)
    with ThreadPoolExecutor(2) as executor, PackageWriter(path, level=1) as writer:
        baking = executor.submit(bake_tables, grid, avatar.rig, config)
        pose, camera = view
        drawn = render(avatar, pose, replace(camera, distortion=()))
        package = _unchecked_package(baking.result(), QUALITY_TIERS, avatar.rig, (), {})
        serialized = executor.map(lambda tier: serialize_graph(package, tier), QUALITY_TIERS)
        writer.add_tables(baking.result())
        graphs = dict(zip(QUALITY_TIERS, serialized, strict=True)) | build_coarse_graph(package)
        writer.finish(replace(package, graphs=graphs, preview=encode_png(straighten(drawn))))


def export_field(
    field_at: FieldFunction,
    rig: Rig,
    occupied: UInt8[np.ndarray, "cx cy cz"],
    path: Path,
    *,
    views: Sequence[PosedView],
    metrics: Mapping[str, Any],
    renderer: RenderFunction,
    config: BakeConfig | None = None,
    baked_first: bool = False,
    progress: ExportProgress = lambda _: None,
) -> Iterator[ExportReport]:
    """Write packages of any canonical field; arguments and errors as of `export_avatar`."""
    if not views:
        raise InputError("An avatar cannot be checked without a pose and a camera; give one view.")
    started, config = time.perf_counter(), config or BakeConfig()
    views = [(pose, replace(camera, distortion=())) for pose, camera in views]
    # the field, and the renderer with it, is evaluated on this thread alone
    with ThreadPoolExecutor(2) as executor:
        baking = executor.submit(
            bake_tables, sample_field(field_at, rig, occupied=occupied, config=config), rig, config
        )
        exact = [picture_on_white(renderer(pose, fit_camera(c, CHECK_PX))) for pose, c in views]
        draft = _PackageDraft(
            path=path, rig=rig, views=views, exact=exact, metrics=metrics, executor=executor
        )
        baked = FineTuningResult(tables=baking.result(), settings=QUALITY_TIERS, psnr=None)
        first: AvatarPackage | None = None
        if baked_first or not config.fine_tuning_pictures:
            first, report = draft.write(
                baked, seconds=time.perf_counter() - started, level=1 if baked_first else 6
            )
            yield report
            started = time.perf_counter()
        if not config.fine_tuning_pictures:
            return

        def bake_again(tables: PlayerTables) -> PlayerTables:
            thick = config.for_thick_field(estimate_brick_bytes(tables.bricks))
            return bake_tables(
                sample_field(field_at, rig, occupied=occupied, config=thick), rig, thick
            )

        tuned = _fine_tune(
            FineTuningInputs(
                tables=baked.tables, rig=rig, settings=QUALITY_TIERS, renderer=renderer,
                views=views, executor=executor,
            ),
            bake_again, config.fine_tuning_pictures,
            lambda done: progress(0.25 + 0.55 * done),  # the rest are the checks
        )  # fmt: skip
        warnings = [] if tuned.psnr else [INTERRUPTED_WARNING]
        if tuned.psnr or not baked_first:
            checked = first if tuned.settings == QUALITY_TIERS else None
            _, report = draft.write(
                tuned, warnings, seconds=time.perf_counter() - started, checked=checked
            )
            yield report


@dataclass(frozen=True, eq=False, kw_only=True)
class _PackageDraft:
    """What the packages of an export have in common; `exact` are the views by the renderer."""

    path: Path
    rig: Rig
    views: Sequence[PosedView]
    exact: Sequence[Float32[np.ndarray, "_ _ 3"]]
    metrics: Mapping[str, Any]
    executor: Executor

    def write(
        self,
        tuned: FineTuningResult,
        warnings: Sequence[str] = (),
        *,
        seconds: float,
        checked: AvatarPackage | None = None,
        level: int = 6,
    ) -> tuple[AvatarPackage, ExportReport]:
        """Check and write a package, which took `seconds` so far; `level` is zlib's.

        Its graphs are those of `checked`, an earlier package of the same settings, if there is one:
        only the tables differ.
        """
        started = time.perf_counter()
        with PackageWriter(self.path, level=level) as writer:
            package = _unchecked_package(
                tuned.tables, tuned.settings, self.rig, self.views, self.metrics
            )
            if checked:
                package = replace(package, graphs=checked.graphs)
            players = {
                tier: self.executor.submit(_prepare_player, package, tier)
                for tier in package.manifest.tiers
            }
            writer.add_tables(tuned.tables)  # compressed beside them
            prepared = {tier: player.result() for tier, player in players.items()}
            package = self._check(package, prepared, list(warnings), checked)
            size = writer.finish(package)
        tiers = package.manifest.tiers
        return package, ExportReport(
            path=self.path,
            bytes=size,
            seconds=seconds + time.perf_counter() - started,
            psnr_to_renderer={name: tier.psnr_to_renderer for name, tier in tiers.items()},
            largest_difference=max(tier.largest_difference for tier in tiers.values()),
            warnings=tuple(package.manifest.metrics["warnings"]),
        )

    def _check(
        self,
        package: AvatarPackage,
        players: Mapping[str, tuple[bytes, Player]],
        warnings: list[str],
        checked: AvatarPackage | None,
    ) -> AvatarPackage:
        """Check every tier, its graph unless it is in `checked`; add what is missing."""
        manifest, pairs = package.manifest, list(zip(self.views, self.exact, strict=True))
        checks, scores = dict[str, Future[float]](), dict[str, list[Future[float]]]()
        for tier, (_, player) in players.items():
            if not checked:
                checks[tier] = self.executor.submit(check_graph, player, package, tier)
            scores[tier] = [
                self.executor.submit(psnr_to_renderer, player, view, truth)
                for view, truth in pairs[: {"hq": None, "lite": 1}[tier]]
            ]
        hq = players["hq"][1]
        shots = [self.views[0], *((frame.pose, frame.camera) for frame in manifest.golden)]
        preview, *golden = self.executor.map(lambda shot: hq.render(*shot), shots)
        tiers = {
            tier: replace(
                info,
                psnr_to_renderer=float(np.mean([score.result() for score in scores[tier]])),
                largest_difference=checked.manifest.tiers[tier].largest_difference
                if checked
                else checks[tier].result(),
            )
            for tier, info in manifest.tiers.items()
        }
        warnings = warnings + quality_warnings(tiers["hq"].psnr_to_renderer)
        graphs = {tier: graph for tier, (graph, _) in players.items()}
        graphs |= checked.graphs if checked else build_coarse_graph(package)
        metrics = {**manifest.metrics, "warnings": warnings}
        return replace(
            package,
            manifest=replace(manifest, tiers=tiers, metrics=metrics),
            graphs=graphs,
            golden=tuple(golden),
            preview=encode_png(preview),
        )


def _fine_tune(
    inputs: FineTuningInputs,
    bake_again: Callable[[PlayerTables], PlayerTables],
    max_pictures: int,
    progress: ExportProgress,
) -> FineTuningResult:
    """Fine-tune bricks until Ctrl-C; bake again where the player is far from the renderer."""
    with suppress(KeyboardInterrupt):
        if is_below_target(inputs):
            settings = {tier: THICK_FIELD_TIERS[tier] for tier in inputs.settings}
            inputs = replace(inputs, tables=bake_again(inputs.tables), settings=settings)
            max_pictures = min(max_pictures, THICK_FIELD_PICTURES)
        return fine_tune(inputs, max_pictures=max_pictures, progress=progress)
    return FineTuningResult(tables=inputs.tables, settings=inputs.settings, psnr=None)


def serialize_graph(package: AvatarPackage, tier: str) -> bytes:
    """Build the graph that draws a tier."""
    settings = package.manifest.tiers[tier].settings
    return build_graph(package.tables[tier], settings).SerializeToString()


def build_coarse_graph(package: AvatarPackage) -> dict[str, bytes]:
    """Build the graph by which a page draws its first picture, of the tables of "lite"."""
    settings = replace(package.manifest.tiers["lite"].settings, layers=1, max_blocks=1)
    return {COARSE_GRAPH: build_graph(package.tables["lite"], settings).SerializeToString()}


def _prepare_player(package: AvatarPackage, tier: str) -> tuple[bytes, Player]:
    """Build the graph of a tier, and its player."""
    graph = package.graphs.get(tier) or serialize_graph(package, tier)
    return graph, Player(replace(package, graphs={tier: graph}), tier=tier, optimize=False)


def _unchecked_package(
    tables: PlayerTables,
    settings: Mapping[str, RenderSettings],
    rig: Rig,
    views: Sequence[PosedView],
    metrics: Mapping[str, Any],
) -> AvatarPackage:
    """Build the package without graphs, scores and pictures."""
    golden = [
        GoldenFrame(pose=pose, camera=fit_camera(camera, MAX_GOLDEN_PX))
        for pose, camera in views[:4]
    ]
    return AvatarPackage(
        manifest=Manifest(
            rest_joints=rig.rest_joints,
            parents=rig.parents,
            canonical_rotations=rig.canonical_rotations,
            tiers=describe_tiers(tables, settings),
            golden=tuple(golden),
            metrics=dict(metrics),
            licence=" ".join(
                [LICENCE_NOTE, *filter(None, [metrics.get("made_with", {}).get("summary")])]
            ),
            sha256={},
        ),
        graphs={},
        tables=dict.fromkeys(settings, tables),
        golden=(),
        preview=b"",
    )


def describe_tiers(
    tables: PlayerTables, settings: Mapping[str, RenderSettings]
) -> dict[str, TierInfo]:
    """Describe tiers that were not checked."""
    layout = TableLayout.of(tables)
    return {
        tier: TierInfo(layout=layout, settings=rule, psnr_to_renderer=0.0, largest_difference=0.0)
        for tier, rule in settings.items()
    }


def encode_png(rgba: UInt8[np.ndarray, "height width 4"]) -> bytes:
    """Encode a picture of straight alpha."""
    buffer = io.BytesIO()
    Image.fromarray(rgba).save(buffer, format="PNG")
    return buffer.getvalue()


POOR_PSNR = 30.0
"""Player against volume renderer, dB: below this a package shows its avatar poorly."""
GOOD_PSNR = 38.0
"""Player against volume renderer, dB: from this on, both look the same."""
SIMPLIFIED_WARNING = (
    "The package simplifies fine detail or soft edges: what it draws is {score:.1f} dB from the "
    "avatar as trained ({good:.0f} dB and more look the same)."
)
"""Shown between `POOR_PSNR` and `GOOD_PSNR`."""
POOR_WARNING = (
    "The package shows the avatar poorly: what it draws is only {score:.1f} dB from the avatar as "
    "trained ({good:.0f} dB and more look the same). The avatar is still fog rather than a "
    "surface; train longer (ia-ingest --resume, and more --seconds or --steps)."
)
"""Shown below `POOR_PSNR`."""
CHECK_PX = 256
"""Longer side of the pictures that are compared with the volume renderer, pixels."""


def check_graph(player: Player, package: AvatarPackage, tier: str) -> float:
    """Return the largest difference of a tier's graph from its rays composited here, in 1/255."""
    tables, settings = package.tables[tier], package.manifest.tiers[tier].settings
    tracer, largest = RayTracer(tables, settings), 0.0
    # the arithmetic of this machine's onnxruntime; further poses would test the same
    for frame in package.manifest.golden[: {"hq": 2, "lite": 1}[tier]]:
        traced = tracer.trace(player.bones(frame.pose, frame.camera), frame.camera)
        drawn = premultiply(player.render(frame.pose, frame.camera))
        difference = PictureDifference.of(
            drawn, draw_traced(traced, tables, settings, frame.camera.size_px)
        )
        if not difference.matches:
            raise ExportRefused(
                f"In one view the player's graph ({tier}) is {difference.psnr:.1f} dB from its "
                f"rays as they were traced; at least {MIN_SAME_PSNR:.0f} dB are required. Nothing "
                "was written; the checkpoint is kept. This is a fault of the program: please "
                "report it with the version of onnxruntime."
            )
        largest = max(largest, difference.largest_difference)
    return largest


def psnr_to_renderer(player: Player, view: PosedView, exact: Float32[np.ndarray, "_ _ 3"]) -> float:
    """Return the PSNR of the player to the renderer's picture of a view on white, dB."""
    pose, camera = view
    drawn = picture_on_white(premultiply(player.render(pose, fit_camera(camera, CHECK_PX))))
    return min(psnr(drawn, exact), 99.0)


def quality_warnings(score: float) -> list[str]:
    """Return the warnings for a player with this mean PSNR to the renderer, dB."""
    if score >= GOOD_PSNR:
        return []
    text = POOR_WARNING if score < POOR_PSNR else SIMPLIFIED_WARNING
    return [text.format(score=score, good=GOOD_PSNR)]


def write_warm_up_package(path: Path) -> None:
    """Write a package of two surfels, as high as a person, and an empty brick."""
    origin = np.zeros(3, np.float32)
    tables = PlayerTables(
        surfels=SurfelTable(
            low=origin - 1.0, extent_m=2.0, spacing_m=0.01,
            position_codes=np.array([[1 << 15, 0, 1 << 15], [1 << 15, 65535, 1 << 15]], np.uint16),
            normal_codes=np.array([[0, 0, 127]] * 2, np.int8),
            thickness_codes=np.full(2, 40, np.uint8),
        ),
        bricks=BrickTable(
            low=origin, voxel_m=0.01, index=np.ones((1, 1, 1), np.int32),
            voxels=np.zeros((2, *[BRICK_NODES] * 3, 4), np.uint8),
        ),
        skinning=SkinningGrid(
            low=origin - 2.0, step_m=origin + 4.0,
            index=np.arange(1, 9, dtype=np.int32).reshape(2, 2, 2),
            weight_codes=np.eye(24, 1, dtype=np.uint16).repeat(9, axis=1) * WEIGHT_SCALE,
        ),
        pelvis=origin, reach_m=2.0,
    )  # fmt: skip
    manifest = Manifest(
        rest_joints=np.zeros((24, 3)), parents=np.array(PARENTS),
        canonical_rotations=canonical_rotations(), tiers=describe_tiers(tables, QUALITY_TIERS),
        golden=(), metrics={}, sha256={},
    )  # fmt: skip
    package = AvatarPackage(
        manifest=manifest, graphs={}, tables=dict.fromkeys(QUALITY_TIERS, tables), golden=(),
        preview=encode_png(np.zeros((1, 1, 4), np.uint8)),
    )  # fmt: skip
    graphs = {tier: serialize_graph(package, tier) for tier in QUALITY_TIERS}
    write_package(replace(package, graphs=graphs | build_coarse_graph(package)), path)

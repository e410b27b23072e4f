"""Avatar to package: bakes, builds, checks, and only then writes."""

import io
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from PIL import Image

from avatar.deformation.rig import Rig
from avatar.field.avatar_model import Avatar
from avatar.render import render
from capture.camera import Camera
from capture.input_error import InputError
from export.bake.bake_tables import BakeConfig, bake_tables, sample_field
from export.bake.field_grid import FieldFunction
from export.bake.fine_tuning import ExportProgress, FineTuningResult, fine_tune, is_below_target
from export.bake.render_targets import PosedView, RenderFunction, RgbaPicture
from export.graph.player_graph import build_graph
from export.package.manifest import MAX_GOLDEN_PX, GoldenFrame, Manifest, TierInfo
from export.package.package_file import AvatarPackage, PackageWriter
from export.package.player_tables import PlayerTables
from export.package.render_settings import QUALITY_TIERS, RenderSettings
from export.package.table_codec import TableLayout
from export.package_checks import (
    CHECK_PX,
    check_graph,
    fit_camera,
    mean_psnr_to_renderer,
    quality_warnings,
)
from export.picture_difference import picture_on_white
from export.player import Player
from preprocess.body.body_pose import BodyPose

GRAPH_CHECK_PICTURES = {"hq": 2, "lite": 1}
"""Pictures of each tier's graph that are compared with its meaning in numpy, 0.2 s each. They prove
the arithmetic of this machine's onnxruntime, and further poses would prove it again."""
MAX_GOLDEN_FRAMES = 4
BAKING_PROGRESS, FINE_TUNING_PROGRESS = 0.25, 0.55
"""Of an export's time, baking comes first and fine-tuning follows; the rest are the checks."""
INTERRUPTED_WARNING = (
    "Fine-tuning was interrupted: the package holds the bricks as they were baked, and looks about "
    "half a decibel less like the avatar. ia-export does it all again."
)


@dataclass(frozen=True, eq=False, kw_only=True)
class ExportReport:
    """What became of an export.

    Attributes:
        path: The package.
        bytes: Its size.
        seconds: Wall time of baking, checking and writing.
        psnr_to_renderer: Of each tier, dB, mean over the views.
        largest_difference: Between graph and reference, in 1/255.
        tuning: PSNR to the volume renderer's before and after fine-tuning, dB, of pictures that
            it has not seen; None if it was left out.
        warnings: What the user should know.
    """

    path: Path
    bytes: int
    seconds: float
    psnr_to_renderer: Mapping[str, float]
    fine_tuning_psnr: tuple[float, float] | None
    largest_difference: float
    warnings: tuple[str, ...]


def export_avatar(
    avatar: Avatar,
    path: Path,
    *,
    views: Sequence[PosedView],
    metrics: Mapping[str, Any],
    renderer: Callable[[Avatar, BodyPose, Camera], RgbaPicture] = render,
    config: BakeConfig | None = None,
    quick: bool = False,
    fine_tune_bricks: bool = True,
    progress: ExportProgress = lambda _: None,
) -> ExportReport:
    """Writes an avatar's package, or nothing.

    Args:
        avatar: As training left it.
        path: The `.iavatar` file; replaced at once if it exists.
        views: Poses and cameras to check it with, at least one; the first is the preview, and
            the first few become golden frames. Lens distortion is left out.
        metrics: What training reported, kept in the manifest (JSON).
        renderer: The exact picture of an avatar.
        config: How finely to bake; follows the field's own finest cells if None.
        hasty: Whether it is wanted at once: coarser, with one quality alone and not fine-tuned.
        fine_tuned: Whether bricks are fine-tuned against the renderer's pictures, some ten
            seconds; a hasty package's never are.
        progress: Gets the share of the export that is done, from 0 to 1, while bricks are
            fine-tuned. Ctrl-C meanwhile ends that alone.

    Raises:
        ExportRefused: If there is nothing to draw, or this machine's onnxruntime does not compute
            what the graph says.
        OSError: If it cannot be written.
    """
    occupied = avatar.rendering_grid().occupied.cpu().numpy()
    device = avatar.field.table.device
    finest_m = 1.0 / float(avatar.field.levels.cells_per_m[-1])

    def field_at(
        points: Float32[torch.Tensor, "points 3"],
    ) -> tuple[Float32[torch.Tensor, "points 3"], Float32[torch.Tensor, "points"]]:
        rgb, density = avatar.color_and_density_at(points.to(device))
        return rgb.cpu(), density.cpu()

    config = config or BakeConfig.for_cell_size(finest_m)
    config = config if fine_tune_bricks else replace(config, fine_tuning_pictures=0)
    return export_field(
        field_at,
        avatar.rig,
        occupied,
        path,
        views=views,
        metrics=metrics,
        renderer=lambda pose, camera: renderer(avatar, pose, camera),
        config=config.quick() if quick else config,
        progress=progress,
    )


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
    progress: ExportProgress = lambda _: None,
) -> ExportReport:
    """As `export_avatar`, of any canonical field."""
    if not views:
        raise InputError("An avatar cannot be checked without a pose and a camera; give one view.")
    started, config = time.perf_counter(), config or BakeConfig()
    views = [(pose, replace(camera, distortion=())) for pose, camera in views]
    # the field, and the renderer with it, is asked on this thread alone
    grid = sample_field(field_at, rig, occupied=occupied, config=config)
    with PackageWriter(path) as draft, ThreadPoolExecutor(2) as executor:
        baked = executor.submit(bake_tables, grid, rig, config)
        exact = [picture_on_white(renderer(pose, fit_camera(c, CHECK_PX))) for pose, c in views]

        def finer() -> PlayerTables:
            better = config.with_finer_voxels()
            return bake_tables(
                sample_field(field_at, rig, occupied=occupied, config=better), rig, better
            )

        better = _fine_tune(
            baked.result(), finer, rig, renderer, views, config, executor,
            lambda share: progress(BAKING_PROGRESS + FINE_TUNING_PROGRESS * share),
        )  # fmt: skip
        tables = better.tables
        compressed = executor.submit(draft.add_tables, tables)
        settings = {
            tier: better.settings if tier == "hq" else QUALITY_TIERS[tier] for tier in config.tiers
        }
        package = _unchecked_package(tables, settings, rig, views, metrics)
        others = {t: executor.submit(Player, package, tier=t) for t in config.tiers if t != "hq"}
        hq = Player(package)
        notes, warnings = (
            {},
            [INTERRUPTED_WARNING] if config.fine_tuning_pictures and better.psnr is None else [],
        )
        for tier in config.tiers:
            player = hq if tier == "hq" else others[tier].result()
            looks = slice(None) if tier == "hq" else slice(1)
            proofs = package.manifest.golden[: GRAPH_CHECK_PICTURES[tier]]
            worst = check_graph(player, package, tier, proofs)
            score = mean_psnr_to_renderer(player, views[looks], exact[looks])
            warnings += quality_warnings(score) if tier == "hq" else []
            note = package.manifest.tiers[tier]
            notes[tier] = replace(note, psnr_to_renderer=score, largest_difference=worst)
        golden = tuple(hq.render(frame.pose, frame.camera) for frame in package.manifest.golden)
        package = replace(
            package,
            manifest=replace(
                package.manifest, tiers=notes, metrics={**metrics, "warnings": warnings}
            ),
            golden=golden,
            preview=_encode_png(hq.render(*views[0])),
        )
        compressed.result()
        size = draft.finish(package)
    return ExportReport(
        path=path,
        bytes=size,
        seconds=time.perf_counter() - started,
        psnr_to_renderer={tier: note.psnr_to_renderer for tier, note in notes.items()},
        largest_difference=max(note.largest_difference for note in notes.values()),
        fine_tuning_psnr=better.psnr,
        warnings=tuple(warnings),
    )


def _fine_tune(
    tables: PlayerTables,
    finer: Callable[[], PlayerTables],
    rig: Rig,
    renderer: RenderFunction,
    views: Sequence[PosedView],
    config: BakeConfig,
    executor: Executor,
    progress: ExportProgress,
) -> FineTuningResult:
    """Fine-tunes, if that is wanted, finer bricks where the player is too far from the renderer.

    Ctrl-C leaves the bricks as they are, and goes on.
    """
    if config.fine_tuning_pictures:
        with suppress(KeyboardInterrupt):
            settings = QUALITY_TIERS["hq"]
            far = is_below_target(tables, rig, settings, renderer, views=views, executor=executor)
            tables = finer() if far else tables
            return fine_tune(
                tables, rig, settings, renderer,
                views=views, max_pictures=config.fine_tuning_pictures, executor=executor, may_add_layers=far, progress=progress,
            )  # fmt: skip
    return FineTuningResult(tables=tables, settings=QUALITY_TIERS["hq"], psnr=None)


def _unchecked_package(
    tables: PlayerTables,
    settings: Mapping[str, RenderSettings],
    rig: Rig,
    views: Sequence[PosedView],
    metrics: Mapping[str, Any],
) -> AvatarPackage:
    """The package as it stands before the checks: no scores, no pictures."""
    notes = {
        tier: TierInfo(
            layout=TableLayout.of(tables),
            settings=rule,
            psnr_to_renderer=0.0,
            largest_difference=0.0,
        )
        for tier, rule in settings.items()
    }
    golden = [
        GoldenFrame(pose=pose, camera=fit_camera(camera, MAX_GOLDEN_PX))
        for pose, camera in views[:MAX_GOLDEN_FRAMES]
    ]
    return AvatarPackage(
        manifest=Manifest(
            rest_joints=rig.rest_joints,
            parents=rig.parents,
            canonical_rotations=rig.canonical_rotations,
            tiers=notes,
            golden=tuple(golden),
            metrics=dict(metrics),
            sha256={},
        ),
        graphs={
            tier: build_graph(tables, rule).SerializeToString() for tier, rule in settings.items()
        },
        tables=dict.fromkeys(settings, tables),
        golden=(),
        preview=b"",
    )


def _encode_png(rgba: UInt8[np.ndarray, "height width 4"]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(rgba).save(buffer, format="PNG")
    return buffer.getvalue()

"""The avatar as it stands at this second, as a package that the player opens."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from apps.report.learning_curve import CurvePoint
from avatar.evaluation.held_out import HeldOutFrame, subsample_evenly
from avatar.training.trainer import Trainer
from export.bake.bake_tables import ExportRefused
from export.bake.render_targets import PosedView
from export.build import ExportReport, export_avatar
from preprocess.capture_session import Capture
from preprocess.observe import shrink_to_longer_side

VALIDATION_VIEWS, QUICK_VALIDATION_VIEWS = 4, 2


@dataclass(frozen=True, kw_only=True)
class PackageSnapshot:
    """What became of it.

    Attributes:
        exported: The package that was written, if one was.
        refused: Why there is none, otherwise.
        ready_at: When the package stood under its name, on `time.perf_counter`'s clock.
    """

    export_report: ExportReport | None
    refusal: str | None
    ready_at: float


def write_package_snapshot(
    trainer: Trainer,
    path: Path,
    views: Sequence[PosedView],
    *,
    curve_point: CurvePoint | None,
    quick: bool = False,
    fine_tune: bool = True,
    progress: Callable[[float], None] = lambda _: None,
) -> PackageSnapshot:
    """Writes the package, whole or not at all; training may go on afterwards.

    Args:
        trainer: Whose avatar; not in the middle of a step.
        path: The `.iavatar` file; what is there already is replaced only by something better
            than nothing.
        views: Poses and cameras to check it with (`validation_views`).
        mark: How well held-out frames were rendered when that was last asked; goes with it.
        hasty: Whether somebody waits for it; a finer one can replace it later (`finer`).
        fine_tuned: Whether there are ten seconds more, for a better likeness.
        progress: Gets the share that is done, from 0 to 1.

    Raises:
        OSError: If the disk is full; what was there before stays.
    """
    metrics = {
        "held_out": None if curve_point is None else asdict(curve_point),
        "recipe": asdict(trainer.config),
    }
    try:
        exported = export_avatar(
            trainer.avatar,
            path,
            views=views[:QUICK_VALIDATION_VIEWS] if quick else views,
            metrics=metrics,
            quick=quick,
            fine_tune_bricks=fine_tune,
            progress=progress,
        )
    except ExportRefused as error:
        return PackageSnapshot(export_report=None, refusal=str(error), ready_at=time.perf_counter())
    return PackageSnapshot(export_report=exported, refusal=None, ready_at=time.perf_counter())


def prefer_final(quick: PackageSnapshot, final: PackageSnapshot) -> PackageSnapshot:
    """What there is after a hasty package was replaced, if it was; it was ready with the first."""
    if quick.export_report is None:
        return final
    return quick if final.export_report is None else replace(final, ready_at=quick.ready_at)


def validation_views(held_out: list[HeldOutFrame], recording: Capture) -> Sequence[PosedView]:
    """Poses and cameras to check a player with: held-out frames, else the first valid pose."""
    seen = [frame.observation for frame in subsample_evenly(held_out, VALIDATION_VIEWS)]
    if seen:
        return [(observation.pose, observation.camera) for observation in seen]
    row = int(np.flatnonzero(recording.motion.valid)[0])
    size = shrink_to_longer_side(recording.source.size_px, recording.size_px)
    return [(recording.motion[row], recording.camera_of_pose(row).resize(size))]

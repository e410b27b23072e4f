"""Write the avatar in its current state as a package for the player."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from apps.report.learning_curve import CurvePoint
from avatar.evaluation.held_out import HeldOutFrame, subsample_evenly
from avatar.training.trainer import Trainer
from export.bake.bake_tables import ExportRefused
from export.bake.fine_tuning import PosedView
from export.build import ExportReport, export_avatar
from export.package.package_file import update_metrics
from preprocess.capture_session import Capture
from preprocess.observation import shrink_to_longer_side

VALIDATION_VIEWS = 4
"""Views that a package is validated with."""
QUICK_VALIDATION_VIEWS = 2
"""Views that a quick package is validated with."""


@dataclass(frozen=True, kw_only=True)
class PackageSnapshot:
    """Outcome of writing a package.

    Attributes:
        export_report: Describes the package; None if it was refused.
        refusal: Why no package was written; None if one was.
        ready_at: When the file was complete, on `time.perf_counter`'s clock.
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
    """Write the package, whole or not at all; training may continue afterwards.

    Args:
        trainer: Holds the avatar; not in the middle of a step.
        path: The `.iavatar` file; an existing one is kept if the package is refused.
        views: Poses and cameras to validate the package with (`validation_views`).
        curve_point: Latest scores of held-out frames, stored in the package.
        quick: Whether to skip the finest detail because the user waits (`prefer_final`).
        fine_tune: Whether to spend about ten seconds on fine-tuning the bricks.
        progress: Called with the fraction done, from 0 to 1.

    Raises:
        OSError: If the disk is full; an existing package is kept.
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


def store_scores(snapshot: PackageSnapshot, scores: CurvePoint) -> PackageSnapshot:
    """Replace the scores in the package that was written, if one was.

    Raises:
        OSError: If the disk is full; the package is kept as it was.
    """
    exported = snapshot.export_report
    if exported is None:
        return snapshot
    size = update_metrics(exported.path, {"held_out": asdict(scores)})
    return replace(snapshot, export_report=replace(exported, bytes=size))


def prefer_final(quick: PackageSnapshot, final: PackageSnapshot) -> PackageSnapshot:
    """Return the package on disk after a quick one; it was ready when the quick one was."""
    if quick.export_report is None:
        return final
    return quick if final.export_report is None else replace(final, ready_at=quick.ready_at)


def validation_views(held_out: list[HeldOutFrame], recording: Capture) -> Sequence[PosedView]:
    """Return views to validate a package with: held-out frames, else the first valid pose."""
    seen = [frame.observation for frame in subsample_evenly(held_out, VALIDATION_VIEWS)]
    if seen:
        return [(observation.pose, observation.camera) for observation in seen]
    row = int(np.flatnonzero(recording.motion.valid)[0])
    size = shrink_to_longer_side(recording.source.size_px, recording.size_px)
    return [(recording.motion[row], recording.camera_of_pose(row).resize(size))]

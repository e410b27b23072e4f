"""The avatar as it stands at this second, as a package that the player opens."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from apps.recording.recording import Recording
from apps.reporting.curve import CurvePoint
from avatar.hold import HeldOut, spread
from avatar.trainer import Trainer
from export.build import ExportReport, View, export_avatar
from export.errors import ExportRefused
from preprocess.observe import shrunk

CHECKED_VIEWS, HASTY_VIEWS = 4, 2


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """What became of it.

    Attributes:
        exported: The package that was written, if one was.
        refused: Why there is none, otherwise.
        ready_at: When the package stood under its name, on `time.perf_counter`'s clock.
    """

    exported: ExportReport | None
    refused: str | None
    ready_at: float


def snapshot(
    trainer: Trainer,
    path: Path,
    views: Sequence[View],
    *,
    mark: CurvePoint | None,
    hasty: bool = False,
    fine_tuned: bool = True,
    progress: Callable[[float], None] = lambda _: None,
) -> Snapshot:
    """Writes the package, whole or not at all; training may go on afterwards.

    Args:
        trainer: Whose avatar; not in the middle of a step.
        path: The `.iavatar` file; what is there already is replaced only by something better
            than nothing.
        views: Poses and cameras to check it with (`views_of`).
        mark: How well held-out frames were rendered when that was last asked; goes with it.
        hasty: Whether somebody waits for it; a finer one can replace it later (`finer`).
        fine_tuned: Whether there are ten seconds more, for a better likeness.
        progress: Gets the share that is done, from 0 to 1.

    Raises:
        OSError: If the disk is full; what was there before stays.
    """
    metrics = {
        "held_out": None if mark is None else asdict(mark),
        "recipe": asdict(trainer.config),
    }
    try:
        exported = export_avatar(
            trainer.avatar,
            path,
            views=views[:HASTY_VIEWS] if hasty else views,
            metrics=metrics,
            hasty=hasty,
            fine_tuned=fine_tuned,
            progress=progress,
        )
    except ExportRefused as error:
        return Snapshot(exported=None, refused=str(error), ready_at=time.perf_counter())
    return Snapshot(exported=exported, refused=None, ready_at=time.perf_counter())


def finer(first: Snapshot, later: Snapshot) -> Snapshot:
    """What there is after a hasty package was replaced, if it was; it was ready with the first."""
    if first.exported is None:
        return later
    return first if later.exported is None else replace(later, ready_at=first.ready_at)


def views_of(held: list[HeldOut], recording: Recording) -> Sequence[View]:
    """Poses and cameras to check a player with: held-out frames, else the first valid pose."""
    seen = [frame.observation for frame in spread(held, CHECKED_VIEWS)]
    if seen:
        return [(observation.pose, observation.camera) for observation in seen]
    row = int(np.flatnonzero(recording.motion.valid)[0])
    size = shrunk(recording.source.size_px, recording.size_px)
    return [(recording.motion[row], recording.camera_of_row(row).resized(size))]

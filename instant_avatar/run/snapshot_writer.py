"""Write the avatar in its current state: checkpoints while it is trained, and packages."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any, final

import numpy as np

from avatar.evaluation.held_out import HeldOutFrame, subsample_evenly
from avatar.training import checkpoint
from avatar.training.trainer import Trainer
from capture.atomic_files import atomic_file
from capture.source import shrink_to_longer_side
from export.bake.fine_tuning import PosedView
from export.build import ExportReport, export_avatar
from instant_avatar.report.report_schema import CurvePoint
from instant_avatar.run.run_folder import RunFolder
from preprocess.body.parametric_body import write_shaped_body
from preprocess.capture_session import Capture
from preprocess.licence_chain import licence_chain

CHECKPOINT_INTERVAL_S = 5.0
"""Shortest time between two checkpoints, seconds."""
CHECKPOINT_COST_SHARE = 0.02
"""Largest share of the run's CPU time that checkpoints take; where they cost more, they are rarer.
"""


@final
class CheckpointWriter:
    """Writes the checkpoints of one run, one at a time.

    The thread that trains copies the state; another one writes it.
    """

    def __init__(self, run: RunFolder, capture: Capture) -> None:
        """Write nothing yet; body and fit of the capture will go beside the first checkpoint."""
        self._run, self._capture, self._body_written = run, capture, False
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="checkpoint")
        self._pending: Future[float] | None = None
        self._copy_cost_s = self._cpu_interval_s = 0.0
        self._writing, self._saved = 0, list[int]()
        self.restart_interval()

    def restart_interval(self) -> None:
        """Count the time to the next checkpoint from now."""
        self._last, self._cpu_last = time.perf_counter(), time.process_time()

    def is_due(self) -> bool:
        """Return whether the last checkpoint is written and old enough; raise like `wait`."""
        if self._pending is not None:
            if not self._pending.done():
                return False
            self._take_result()
        if time.perf_counter() - self._last < CHECKPOINT_INTERVAL_S:
            return False
        return time.process_time() - self._cpu_last > self._cpu_interval_s

    def begin(self, trainer: Trainer, notes: dict[str, Any], *, trains_on: bool = True) -> None:
        """Start to write a checkpoint with `notes`, after the one before it; raise like `wait`.

        If training goes on meanwhile (`trains_on`), the state is copied.
        """
        self.wait()
        began = time.thread_time()
        get_state = checkpoint.detached_state if trains_on else checkpoint.current_state
        state = get_state(trainer, notes=notes)
        self._copy_cost_s, self._writing = time.thread_time() - began, trainer.steps
        self._pending = self._thread.submit(self._write, state)
        self.restart_interval()

    def wait(self) -> None:
        """Wait until the last checkpoint is written.

        Raises:
            OSError: If it could not be; the one before it is kept.
        """
        if self._pending is not None:
            self._take_result()

    def take_saved(self) -> list[int]:
        """Return the steps of the checkpoints that were written since the last call."""
        saved, self._saved = self._saved, []
        return saved

    def settle(self) -> None:
        """Wait until nothing is being written; `wait` raises the error, if there was one."""
        if self._pending is not None:
            self._pending.exception()

    def _take_result(self) -> None:
        assert self._pending is not None
        done, self._pending = self._pending, None
        # cost / interval = share
        self._cpu_interval_s = (self._copy_cost_s + done.result()) / CHECKPOINT_COST_SHARE
        self._saved.append(self._writing)

    def _write(self, state: dict[str, Any]) -> float:
        """Write a state, and body and fit beside the first; return the CPU time it took."""
        began = time.thread_time()
        checkpoint.write_state(state, self._run.checkpoint)
        if not self._body_written:
            with atomic_file(self._run.body_file) as path:
                write_shaped_body(path, self._capture.shaped)
            for fit in self._capture.fits[-1:]:
                fit.save(self._run.fit_file, self._capture.identity)
            self._body_written = True
        return time.thread_time() - began


VALIDATION_VIEWS = 4
"""Views that a package is validated with."""


def write_packages(
    trainer: Trainer,
    path: Path,
    views: Sequence[PosedView],
    *,
    curve_point: CurvePoint | None,
    made_with: Sequence[Mapping[str, str]] = (),
    baked_first: bool = False,
    fine_tune: bool = True,
    progress: Callable[[float], None] = lambda _: None,
) -> Iterator[ExportReport]:
    """Write the package of a trainer that is between two steps; see `export_avatar`.

    `made_with` are the parts of the avatar's captures (`preprocess.licence_chain`).
    """
    scores = None if curve_point is None else asdict(curve_point)
    return export_avatar(
        trainer.avatar, path, views=views,
        metrics={
            "held_out": scores, "recipe": asdict(trainer.config),
            "made_with": licence_chain(made_with),
        },
        baked_first=baked_first, fine_tune_bricks=fine_tune, progress=progress,
    )  # fmt: skip


def validation_views(held_out: list[HeldOutFrame], recording: Capture) -> Sequence[PosedView]:
    """Return views to validate a package with: held-out frames, else the first valid pose."""
    seen = [frame.observation for frame in subsample_evenly(held_out, VALIDATION_VIEWS)]
    if seen:
        return [(observation.pose, observation.camera) for observation in seen]
    row = int(np.flatnonzero(recording.motion.valid)[0])
    size = shrink_to_longer_side(recording.source.size_px, recording.size_px)
    return [(recording.motion[row], recording.camera_of_pose(row).resize(size))]

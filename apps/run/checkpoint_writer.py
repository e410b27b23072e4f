"""Writes checkpoints on a thread of their own, at a rate that what they cost allows."""

import time
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, final

from apps.run.run_folder import RunFolder
from avatar.training import checkpoint
from avatar.training.trainer import Trainer
from capture.atomic_files import atomic_file
from preprocess.body.parametric_body import write_shaped_body
from preprocess.capture_session import Capture

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
        """Writes nothing yet.

        Args:
            run: Folder of the run.
            capture: Its body and its fit to the masks are written beside the first checkpoint.
        """
        self._run, self._capture, self._body_written = run, capture, False
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="checkpoint")
        self._pending: Future[float] | None = None
        self._copy_cost_s = self._cpu_interval_s = 0.0
        self.restart_interval()

    def restart_interval(self) -> None:
        """Counts the time to the next checkpoint from now."""
        self._last, self._cpu_last = time.perf_counter(), time.process_time()

    def is_due(self) -> bool:
        """Whether the last checkpoint is written and old enough.

        Raises:
            OSError: If the last one could not be written; the one before it is kept.
        """
        if self._pending is not None:
            if not self._pending.done():
                return False
            self._take_result()
        if time.perf_counter() - self._last < CHECKPOINT_INTERVAL_S:
            return False
        return time.process_time() - self._cpu_last > self._cpu_interval_s

    def begin(self, trainer: Trainer, notes: dict[str, Any], *, trains_on: bool = True) -> None:
        """Start to write a checkpoint, after the one before it.

        Args:
            trainer: In the state to save.
            notes: Stored with it.
            trains_on: Whether training goes on meanwhile, so that the state has to be copied.

        Raises:
            OSError: If the one before could not be written.
        """
        self.wait()
        began = time.thread_time()
        get_state = checkpoint.detached_state if trains_on else checkpoint.current_state
        state = get_state(trainer, notes=notes)
        self._copy_cost_s = time.thread_time() - began
        self._pending = self._thread.submit(self._write, state)
        self.restart_interval()

    def wait(self) -> None:
        """Wait until the last checkpoint is written.

        Raises:
            OSError: If it could not be; the one before it is kept.
        """
        if self._pending is not None:
            self._take_result()

    def settle(self) -> None:
        """Wait until nothing is being written; `wait` raises the error, if there was one."""
        if self._pending is not None:
            self._pending.exception()

    def _take_result(self) -> None:
        assert self._pending is not None
        done, self._pending = self._pending, None
        self._cpu_interval_s = (self._copy_cost_s + done.result()) / CHECKPOINT_COST_SHARE

    def _write(self, state: dict[str, Any]) -> float:
        """Write a state, and body and fit beside the first; return the CPU time it took."""
        began = time.thread_time()
        checkpoint.write_state(state, self._run.checkpoint)
        if not self._body_written:
            with atomic_file(self._run.body_file) as path:
                write_shaped_body(path, self._capture.shaped)
            if self._capture.fit is not None:
                self._capture.fit.save(self._run.fit_file, self._capture.identity)
            self._body_written = True
        return time.thread_time() - began

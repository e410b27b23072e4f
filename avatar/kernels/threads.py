"""Threads that run a kernel side by side, each on its share of the work.

numba's own parallel regions compile whatever they call once more in three modules, which took a
third of a first run's compilation, and one of its thread pools ends the process if two threads
enter a region at once. A kernel that releases the GIL needs neither. Waking a thread takes 80 µs,
as with OpenMP (70 µs), where threads sleep in between.
"""

import os
import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any, final

import numba
import numpy as np
import torch

_IN_USE = threading.Lock()
_TEAMS = dict[tuple[int, int], "_Team"]()
"""Waiting threads, by process and number: a forked process has none of its parent's."""


def run_threads(kernel: Callable[..., Any], *arguments: Any) -> None:
    """Runs `kernel(thread, threads, *arguments)` for each thread, and waits for all.

    The kernel releases the GIL. There are `numba.get_num_threads()` threads; while another thread
    of the program uses them, the shares are run one after the other, with the same result.

    Kernels take numbers below 1e-38 for 0: sums of them take ten times as long, and Adam's means
    end there, an eighth of them at a time, where entries of the table have no gradient.
    """
    threads = numba.get_num_threads()
    _run_shares(kernel, [(thread, threads, *arguments) for thread in range(threads)])


def run_blocks(kernel: Callable[..., Any], *arguments: Any) -> None:
    """Runs `kernel(blocks, *arguments)` on each thread, as `run_threads` does.

    Each thread claims block after block (`kernel_compiler.claim`) until none is left, so that one
    whose core is slow, or has other work, is not waited for. No result may depend on who claims.
    """
    blocks = np.array([0, 1])
    _run_shares(kernel, [(blocks, *arguments)] * numba.get_num_threads())


def _run_shares(kernel: Callable[..., Any], shares: list[tuple[Any, ...]]) -> None:
    """Calls the kernel with the arguments of each thread."""
    threads = len(shares)
    is_alone = threads == 1 or not _IN_USE.acquire(blocking=False)
    torch.set_flush_denormal(True)
    try:
        if is_alone:
            for share in shares:
                kernel(*share)
            return
        team = _TEAMS.pop((os.getpid(), threads), None) or _Team(threads)
        team.run(kernel, shares)
        _TEAMS[os.getpid(), threads] = team  # one that an interrupt left waiting is not used again
    finally:
        torch.set_flush_denormal(False)
        if not is_alone:
            _IN_USE.release()


@final
class _Team:
    """The calling thread, and threads that wait for their share."""

    def __init__(self, threads: int) -> None:
        """Starts all threads but the caller's own."""
        self._shares = SimpleQueue[tuple[Callable[..., Any], tuple[Any, ...]]]()
        self._ends = SimpleQueue[BaseException | None]()
        for _ in range(threads - 1):
            threading.Thread(target=self._serve, daemon=True).start()

    def run(self, kernel: Callable[..., Any], shares: list[tuple[Any, ...]]) -> None:
        """Runs the kernel on all threads; an error of another thread is raised after the last."""
        for share in shares[1:]:
            self._shares.put((kernel, share))
        kernel(*shares[0])
        errors = [self._ends.get() for _ in shares[1:]]
        for error in filter(None, errors):
            raise error

    def _serve(self) -> None:
        torch.set_flush_denormal(True)
        while True:
            kernel, share = self._shares.get()
            error: BaseException | None = None
            try:
                kernel(*share)
            except BaseException as cause:  # the calling thread raises it
                error = cause
            del kernel, share  # nothing is kept alive while waiting
            self._ends.put(error)

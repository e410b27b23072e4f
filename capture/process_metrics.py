"""Figures about this process: its peak memory, and percentiles of an endless stream of numbers."""

import random
import sys
from contextlib import suppress
from pathlib import Path
from typing import final

import numpy as np
import psutil

PROC_STATUS = Path("/proc/self/status")
"""Linux's figures about this process."""


def peak_memory_mb() -> float:
    """The most that this process has held at a time, MiB.

    Linux's getrusage counts what the process that started this one held at that moment, too
    (fs/exec.c sets maxrss of the memory that is left behind); /proc does not.
    """
    try:
        lines = PROC_STATUS.read_text(encoding="ascii").splitlines()
        return next(float(line.split()[1]) / 1024.0 for line in lines if line.startswith("VmHWM:"))
    except (OSError, ValueError, StopIteration):  # another system
        with suppress(ImportError):  # Windows has no such module
            import resource

            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            return peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)
        memory = psutil.Process().memory_info()
        return getattr(memory, "peak_wset", memory.rss) / (1 << 20)


RESERVOIR_SIZE = 4096
"""Numbers that are kept; the percentiles of a shorter stream are exact."""


@final
class ReservoirSample:
    """A uniform sample of `count` numbers so far (Vitter 1985, algorithm R).

    `largest` is the largest of them all; 0 of none.
    """

    def __init__(self, kept: int = RESERVOIR_SIZE) -> None:
        """Start an empty sample of at most `kept` numbers."""
        self._most = kept
        self._kept: list[float] = []
        self._random = random.Random(0)
        self.count = 0
        self.largest = 0.0

    def add(self, number: float) -> None:
        """Take a number in; to be called by one thread."""
        self.count += 1
        self.largest = number if self.count == 1 else max(self.largest, number)
        if len(self._kept) < self._most:
            self._kept.append(number)
            return
        place = self._random.randrange(self.count)
        if place < self._most:
            self._kept[place] = number

    def percentile(self, percent: float) -> float:
        """The number below which `percent` of them lie; 0 of none."""
        return float(np.percentile(self._kept.copy() or [0.0], percent))

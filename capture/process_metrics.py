"""The peak memory of this process."""

import sys
from contextlib import suppress
from pathlib import Path

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

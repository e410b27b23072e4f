"""How much memory this process has needed."""

import resource
import sys
from pathlib import Path

PROC_STATUS = Path("/proc/self/status")


def peak_memory_mb() -> float:
    """The most that this process has held at a time, MiB.

    Linux's getrusage counts what the process that started this one held at that moment, too
    (fs/exec.c sets maxrss of the memory that is left behind); /proc does not.
    """
    try:
        lines = PROC_STATUS.read_text(encoding="ascii").splitlines()
        return next(float(line.split()[1]) / 1024.0 for line in lines if line.startswith("VmHWM:"))
    except (OSError, ValueError, StopIteration):  # another system
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)

"""The machine, the cores that this process may use, and the most memory that it has held."""

import os
import platform
import socket
import sys
from contextlib import suppress
from pathlib import Path

import psutil


def usable_cores() -> int:
    """Return the cores that this process may use: affinity, and the quota of a container."""
    affine = hasattr(os, "sched_getaffinity")  # not everywhere
    cores = len(os.sched_getaffinity(0)) if affine else os.cpu_count() or 1
    with suppress(OSError, ValueError):
        quota, period = (Path("/sys/fs/cgroup") / "cpu.max").read_text(encoding="ascii").split()
        cores = min(cores, max(1, int(quota) // int(period)))
    return cores


def processor_name() -> str:
    """Return what the machine calls its processor."""
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if "model name" in line)
    return platform.processor() or platform.machine()


def describe_machine() -> dict[str, object]:
    """Return host name, processor, cores and memory of this machine."""
    return {
        "host": socket.gethostname(),
        "processor": processor_name(),
        "cores": usable_cores(),
        "memory_mb": round(psutil.virtual_memory().total / 1e6),
    }


def peak_memory_mb() -> float:
    """The most that this process has held at a time, MiB.

    Linux's getrusage counts what the process that started this one held at that moment, too
    (fs/exec.c sets maxrss of the memory that is left behind); /proc does not.
    """
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return next(float(line.split()[1]) / 1024.0 for line in lines if line.startswith("VmHWM:"))
    except (OSError, ValueError, StopIteration):  # another system
        with suppress(ImportError):  # Windows has no such module
            import resource

            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            return peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)
        memory = psutil.Process().memory_info()
        return getattr(memory, "peak_wset", memory.rss) / (1 << 20)

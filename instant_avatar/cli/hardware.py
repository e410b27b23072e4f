"""The machine: what a measurement was made on, its cores, and its memory."""

import os
import platform
import socket
import subprocess
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import psutil

ROOT = Path(__file__).resolve().parents[2]
LIBRARIES = ("numpy", "numba", "torch", "onnxruntime")
CGROUP = Path("/sys/fs/cgroup")
"""Limits of a container (Linux, version 2), which psutil does not know."""


@dataclass(frozen=True, kw_only=True)
class Hardware:
    """The machine, the software and the time of a measurement.

    Attributes:
        commit: Of this checkout; "+" if tracked files differ from it; "unknown" of an installation.
        date: When the measurement began, UTC.
        cores: That this process may use.
        load: How many processes wanted a core in the last minute, before the measurement; above
            a few tenths of `cores`, wall times include other programs.
    """

    commit: str
    date: str
    processor: str
    cores: int
    load: float
    memory_gb: float
    software: str

    @classmethod
    def here(cls) -> "Hardware":
        """This machine, now."""
        libraries = [f"{name} {version(name)}" for name in LIBRARIES]
        return cls(
            commit=_commit(),
            date=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
            processor=processor_name(),
            cores=usable_cores(),
            load=round(psutil.getloadavg()[0], 1),
            memory_gb=round(psutil.virtual_memory().total / 2**30, 1),
            software=", ".join([f"Python {platform.python_version()}", *libraries]),
        )

    def lines(self) -> list[str]:
        """The header of a table."""
        return [
            f"commit {self.commit}, {self.date}",
            f"{self.processor}, {self.cores} cores (load {self.load}), {self.memory_gb} GB",
            self.software,
        ]


def _commit() -> str:
    def git(*arguments: str) -> str:
        command = ["git", *arguments]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        return done.stdout.strip() if done.returncode == 0 else ""

    if git("rev-parse", "--show-toplevel") != str(ROOT):  # an installation may lie in a checkout
        return "unknown"
    code = ("--", ".", ":!docs")  # benchmarks write their pages into docs/
    changed = git("status", "--porcelain", "--untracked-files=no", *code)
    return (git("rev-parse", "--short", "HEAD") or "unknown") + ("+" if changed else "")


def usable_cores() -> int:
    """Return the cores that this process may use: affinity, and the quota of a container."""
    affine = hasattr(os, "sched_getaffinity")  # not everywhere
    cores = len(os.sched_getaffinity(0)) if affine else os.cpu_count() or 1
    with suppress(OSError, ValueError):
        quota, period = (CGROUP / "cpu.max").read_text(encoding="ascii").split()
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

"""What a measurement was made on: commit, date, machine. Stands above every table."""

import os
import platform
import subprocess
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LIBRARIES = ("numpy", "numba", "torch", "onnxruntime")


@dataclass(frozen=True, kw_only=True)
class Hardware:
    """Where and when.

    Attributes:
        commit: Of this checkout; "+" if tracked files differ from it; "unknown" of an installation.
        date: When the measurement began, UTC.
        processor: As the machine calls it.
        cores: That this process may use.
        load: How many processes wanted a core in the last minute, before the measurement; above
            a few tenths of `cores`, wall times include other programs.
        memory_gb: Of the machine.
        software: Versions.
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
            processor=_processor(),
            cores=_cores(),
            load=round(os.getloadavg()[0], 1),
            memory_gb=round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
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
    changed = git("status", "--porcelain", "--untracked-files=no")
    return (git("rev-parse", "--short", "HEAD") or "unknown") + ("+" if changed else "")


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):  # not everywhere
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _processor() -> str:
    told = Path("/proc/cpuinfo")
    for line in told.read_text().splitlines() if told.exists() else ():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()

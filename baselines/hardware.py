"""What a measurement was made on, and the root of the checkout."""

import platform
import subprocess
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import psutil

from capture.hardware import processor_name, usable_cores

ROOT = Path(__file__).resolve().parents[1]
LIBRARIES = ("numpy", "numba", "torch", "onnxruntime")


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

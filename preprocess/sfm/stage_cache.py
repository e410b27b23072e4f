"""A folder in which long work is done in stages: what is finished is not done again."""

import json
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, final

from capture.atomic_files import write_text_atomically
from capture.process_metrics import peak_memory_mb

STAGES_FILE = "stages.json"
"""What the folder's stages have cost, by name."""
StageProgressFn = Callable[[str, float], None]
"""Called now and then with a stage's name and how much of it is done, in [0, 1]."""


@final
class StageCache:
    """Names the parts of the work, times them, and remembers which are done.

    A stage writes to a name that passes (`.part`); its result takes its own name when it is whole.

    Attributes:
        folder: Where results lie.
        costs: Of each finished stage: wall and core seconds, also from an earlier process.
    """

    def __init__(self, folder: Path, told: StageProgressFn) -> None:
        """Takes up what lies in the folder."""
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self._told = folder, told
        self._notes = folder / STAGES_FILE
        self.costs: dict[str, dict[str, float]] = {}
        if self._notes.exists():
            self.costs = json.loads(self._notes.read_text(encoding="utf-8"))

    def run_or_reuse(
        self, name: str, make: Callable[[Path, Callable[[float], None]], None]
    ) -> Path:
        """The file or folder of a stage, made if it is not there yet.

        Args:
            name: Of the result.
            make: Writes it to a path, telling how far it is.
        """
        path = self.folder / name
        if path.exists() and name in self.costs:
            return path
        part = self.folder / f"part.{name}"
        for old in (part, path):
            _remove(old)
        with self._timed(name):
            make(part, lambda share: self._told(name, share))
            part.rename(path)
        return path

    @contextmanager
    def _timed(self, name: str) -> Iterator[None]:
        wall, core = time.perf_counter(), time.process_time()
        self._told(name, 0.0)
        yield
        self._told(name, 1.0)
        self.costs[name] = {
            "wall_seconds": time.perf_counter() - wall,
            "cpu_seconds": time.process_time() - core,
            "peak_memory_mb": peak_memory_mb(),
        }
        write_text_atomically(self._notes, json.dumps(self.costs, indent=1))

    def totals(self) -> dict[str, Any]:
        """Time and memory of all stages together, for the report."""
        return {
            "wall_seconds": sum(cost["wall_seconds"] for cost in self.costs.values()),
            "cpu_seconds": sum(cost["cpu_seconds"] for cost in self.costs.values()),
            "peak_memory_mb": max(
                (cost["peak_memory_mb"] for cost in self.costs.values()), default=0.0
            ),
        }


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)

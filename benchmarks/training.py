"""The training core against what was asked of it: one table, ratios within one run.

    python -m benchmarks.training [--quick] [--device cpu] [--json FILE]

Alternatives take turns in one process; times are those of one core unless the row says otherwise.
There are no thresholds here: whether a mark is reached is for the reader to see.
"""

import json
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro

from avatar.rig import Rig
from benchmarks.hardware import Hardware
from benchmarks.marks import Mark, table
from benchmarks.stage import assembled, filmed, opened, recipe, train_for_core_seconds
from benchmarks.steps import encode_marks, step_marks
from benchmarks.stopwatch import use_threads

SIZE_PX = 256
LEARNT_SECONDS = 15.0
"""How long the avatar has been learnt on which single operations are measured, CPU seconds."""


@dataclass(frozen=True, kw_only=True)
class Training:
    """Measures the training core and prints one table."""

    quick: bool = False
    """Only single operations: neither quality nor start-up nor memory."""
    device: str = "cpu"
    """Where to train."""
    json: Path | None = None
    """File for the figures."""
    keep: Path | None = None
    """Folder for what is filmed; what lies there is used again."""


def main() -> None:
    """The benchmark."""
    job = tyro.cli(Training, prog="python -m benchmarks.training", description=__doc__)
    hardware = Hardware.here()
    with tempfile.TemporaryDirectory() as temporary:
        marks = list(measured(job, job.keep or Path(temporary)))
    print("\n".join([*hardware.lines(), f"device {job.device}", "", *table(marks)]))
    if job.json is not None:
        content = {"hardware": asdict(hardware), "marks": [asdict(mark) for mark in marks]}
        job.json.write_text(json.dumps(content, indent=1) + "\n")


def measured(job: Training, folder: Path) -> Iterator[Mark]:
    """All rows; each is also told on standard error as soon as it is known."""
    for measure in _measures(job, folder):
        for mark in measure():
            print(f"{mark.name}: {mark.value} ({mark.beside})", file=sys.stderr, flush=True)
            yield mark


def _measures(job: Training, folder: Path) -> Iterator[Callable[[], list[Mark]]]:
    device = torch.device(job.device)
    recording = opened(filmed(folder / f"sample{SIZE_PX}", SIZE_PX))
    rig = Rig.of(recording.shaped)
    seen = assembled(recording, rig, recipe(recording, 60.0, refine_poses=False), device)
    use_threads(1)
    train_for_core_seconds(seen.trainer, LEARNT_SECONDS)
    yield lambda: step_marks(seen, device)
    yield lambda: encode_marks(seen, device)


if __name__ == "__main__":
    main()

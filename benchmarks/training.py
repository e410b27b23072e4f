"""The training core against what was asked of it: one table, ratios within one run.

    python -m benchmarks.training [--quick] [--device cpu] [--json FILE]

Alternatives take turns in one process; times are those of one core unless the row says otherwise.
There are no thresholds here: whether a mark is reached is for the reader to see.
"""

import itertools
import json
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import torch
import tyro

from apps.terminal.device import device_for
from apps.terminal.exit_codes import exit_code
from avatar.rig import Rig
from benchmarks.builds import build_marks
from benchmarks.hardware import Hardware
from benchmarks.marks import Mark, table
from benchmarks.quality import core_second_marks, refinement_marks, wall_marks
from benchmarks.skipping import skipping_marks
from benchmarks.stage import assembled, filmed, opened, recipe, train_for_core_seconds
from benchmarks.startup import memory_marks, start_marks
from benchmarks.steps import encode_marks, step_marks
from benchmarks.stopwatch import use_threads
from benchmarks.warps import warp_marks
from preprocess.pose_file import read_motion

SIZE_PX = 256
TEN_MINUTES = 600.0
"""What patience adds to a minute, at 540 px."""
LEARNT_SECONDS = 15.0
"""How long the avatar has been learnt on which single operations are measured, CPU seconds."""


@dataclass(frozen=True, kw_only=True)
class Training:
    """Measures the training core and prints one table."""

    quick: bool = False
    """Only single operations: neither quality nor start-up nor memory."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train."""
    json: Path | None = None
    """File for the figures."""
    keep: Path | None = None
    """Folder for what is filmed; what lies there is used again."""


def main() -> int:
    """The benchmark; returns its exit code."""
    job = tyro.cli(Training, prog="python -m benchmarks.training", description=__doc__)
    return exit_code("benchmarks.training", lambda: measure(job))


def measure(job: Training) -> int:
    """Measures and prints."""
    hardware = Hardware.here()
    with tempfile.TemporaryDirectory() as temporary:
        marks = list(measured(job, job.keep or Path(temporary)))
    print("\n".join([*hardware.lines(), f"device {job.device}", "", *table(marks)]))
    if job.json is not None:
        content = {"hardware": asdict(hardware), "marks": [asdict(mark) for mark in marks]}
        job.json.write_text(json.dumps(content, indent=1) + "\n")
    return 0


def measured(job: Training, folder: Path) -> Iterator[Mark]:
    """All rows; each is also told on standard error as soon as it is known."""
    device = device_for(job.device)
    small = filmed(folder / f"sample{SIZE_PX}", SIZE_PX)
    groups = [operation_marks(small, device)]
    if not job.quick:
        groups += [
            core_second_marks(folder, device),
            wall_marks(small, {"held out": ("33", "36"), "novel poses": ("31", "34")}, device),
            refinement_marks(folder, device),
            large_marks(folder, device),
        ]
    for mark in itertools.chain.from_iterable(groups):
        print(f"{mark.name}: {mark.value} ({mark.beside})", file=sys.stderr, flush=True)
        yield mark


def operation_marks(capture: Path, device: torch.device) -> Iterator[Mark]:
    """Single operations, on an avatar that has been learnt for a while."""
    recording = opened(capture)
    rig = Rig.of(recording.shaped)
    seen = assembled(recording, rig, recipe(recording, 60.0, refine_poses=False), device)
    use_threads(1)
    train_for_core_seconds(seen.trainer, LEARNT_SECONDS)
    yield from step_marks(seen, device)
    yield from encode_marks(seen, device)
    if device.type == "cpu":  # the other side of the ratio runs there only
        novel = read_motion(capture / "truth" / "novel" / "poses.npz")
        yield from warp_marks(seen, novel[len(novel) // 2].joint_rotations)
        yield from build_marks(capture)
    yield from skipping_marks(seen, device)


def large_marks(folder: Path, device: torch.device) -> Iterator[Mark]:
    """What a long video of large pictures takes; its first 120 frames turn as the others do."""
    large = filmed(folder / "sample540", 540, frames=300, turns=5.0)
    asked = {"held out": ("33", "37"), "novel poses": ("30.5", "34")}
    yield from wall_marks(large, asked, device)
    yield from start_marks(large)
    yield from memory_marks(large, folder / "run540")
    printed = dict.fromkeys(asked, ("", ""))
    yield from wall_marks(large, printed, device, seconds=TEN_MINUTES)


if __name__ == "__main__":
    sys.exit(main())

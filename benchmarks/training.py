"""The training core against what was asked of it: one table, ratios within one run.

    python -m benchmarks.training [--quick] [--json FILE]

Alternatives take turns in one process; times are those of one core unless the row says otherwise.
There are no thresholds here: whether a mark is reached is for the reader to see.
"""

import itertools
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tyro

from avatar.rig import Rig
from benchmarks.measurements import Measurement, print_measurements
from benchmarks.sample_training import (
    film_sample,
    load_trainer,
    open_sample,
    train_for_core_seconds,
    training_config,
)
from benchmarks.startup import measure_startup
from benchmarks.step_timing import step_marks
from benchmarks.stopwatch import limit_threads
from benchmarks.thread_scaling import scaling_marks
from benchmarks.training_quality import (
    measure_by_wall_time,
    measure_pose_refinement,
)
from instant_avatar.cli.command_line import run_command

SIZE_PX = 256
PHONE_SIZE_PX = 304
TEN_MINUTES = 600.0
"""What patience adds to a minute, at 540 px."""
WARMUP_TRAINING_SECONDS = 15.0
"""How long the avatar has been learnt on which single operations are measured, CPU seconds."""


@dataclass(frozen=True, kw_only=True)
class Training:
    """Measures the training core and prints one table."""

    quick: bool = False
    """Only single operations: neither quality nor start-up."""
    json: Path | None = None
    """File for the figures."""
    keep: Path | None = None
    """Folder for what is filmed; what lies there is used again."""


def main() -> int:
    """The benchmark; returns its exit code."""
    job = tyro.cli(Training, prog="python -m benchmarks.training", description=__doc__)
    return run_command("benchmarks.training", lambda: run_benchmark(job))


def run_benchmark(job: Training) -> int:
    """Measures and prints."""
    with tempfile.TemporaryDirectory() as temporary:
        print_measurements(all_marks(job, job.keep or Path(temporary)), job.json)
    return 0


def all_marks(job: Training, folder: Path) -> Iterator[Measurement]:
    """All rows."""
    small = film_sample(folder / f"sample{SIZE_PX}", SIZE_PX)
    phone = film_sample(folder / "phone", PHONE_SIZE_PX, like_a_phone=True)
    groups = [scaling_marks(phone), operation_marks(small)]
    if not job.quick:
        groups += [
            measure_by_wall_time(small, {"held out": ("33", "36"), "novel poses": ("31", "34")}),
            measure_pose_refinement(folder),
            large_marks(folder),
        ]
    return itertools.chain.from_iterable(groups)


def operation_marks(capture: Path) -> Iterator[Measurement]:
    """Single operations, on an avatar that has been learnt for a while."""
    recording = open_sample(capture)
    rig = Rig.from_shaped_body(recording.shaped)
    seen = load_trainer(recording, rig, training_config(recording, 60.0, refine_poses=False))
    limit_threads(1)
    train_for_core_seconds(seen.trainer, WARMUP_TRAINING_SECONDS)
    yield from step_marks(seen)


def large_marks(folder: Path) -> Iterator[Measurement]:
    """What a long video of large pictures takes; its first 120 frames turn as the others do."""
    large = film_sample(folder / "sample540", 540, frames=300, turns=5.0)
    asked = {"held out": ("33", "37"), "novel poses": ("30.5", "34")}
    yield from measure_by_wall_time(large, asked)
    yield from measure_startup(large)
    printed = dict.fromkeys(asked, ("", ""))
    yield from measure_by_wall_time(large, printed, seconds=TEN_MINUTES)


if __name__ == "__main__":
    sys.exit(main())

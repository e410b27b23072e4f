"""The player against what was asked of it: cost, likeness and size on avatars of the sample.

    python -m benchmarks.player [--quick] [--json FILE] [--keep FOLDER]

Films two actors, learns each for a minute as a user does, bakes what was learnt and plays it on one
thread. Costs are CPU time, and their ratio to a small reference graph that runs in between; the
volume renderer's pictures and the studio's are what the player is compared with. There are no
thresholds here: whether a mark is reached is for the reader to see (`benchmarks.any_film` compares
the player of real people with the renderer).
"""

import itertools
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tyro

from avatar.training import checkpoint
from avatar.training.trainer import Trainer
from baselines.hardware import ROOT
from benchmarks.measurements import Measurement, print_measurements
from benchmarks.player_cost import frame_time_marks, load_time_marks, package_marks, time_bake
from benchmarks.player_fidelity import (
    fidelity_marks,
    views_of_sample,
)
from benchmarks.sample_training import film_sample
from benchmarks.stopwatch import limit_threads
from instant_avatar.cli.command_line import run_command

SIZE_PX = 540
FRAMES = 120
SECONDS = 60.0


@dataclass(frozen=True, kw_only=True)
class PlayerBenchmark:
    """Measures the player and prints one table."""

    quick: bool = False
    """One actor and half of the pictures."""
    json: Path | None = None
    """File for the figures."""
    keep: Path | None = None
    """Folder for what is filmed and learnt; what lies there is used again."""


def main() -> int:
    """The benchmark; returns its exit code."""
    job = tyro.cli(PlayerBenchmark, prog="python -m benchmarks.player", description=__doc__)
    return run_command("benchmarks.player", lambda: measure(job))


def measure(job: PlayerBenchmark) -> int:
    """Measures and prints."""
    with tempfile.TemporaryDirectory() as temporary:
        print_measurements(measured(job, job.keep or Path(temporary)), job.json)
    return 0


def measured(job: PlayerBenchmark, folder: Path) -> Iterator[Measurement]:
    """All rows."""
    subjects = (1,) if job.quick else (1, 2)
    groups = [subject_marks(folder, subject, quick=job.quick) for subject in subjects]
    return itertools.chain.from_iterable(groups)


def subject_marks(folder: Path, subject: int, *, quick: bool) -> Iterator[Measurement]:
    """One actor."""
    suffix = "" if subject == 1 else f"_{subject}"
    capture = film_sample(folder / f"sample{SIZE_PX}{suffix}", SIZE_PX, subject=subject)
    trainer = train_or_load(capture, folder / f"run{SIZE_PX}{suffix}")
    limit_threads(1)
    shots = views_of_sample(capture, trainer.avatar, frames=FRAMES, stride=2 if quick else 1)
    package, name = folder / f"player{SIZE_PX}{suffix}.iavatar", f"subject {subject}"
    yield from package_marks(name, package, time_bake(trainer, package, shots["held out"][:4]))
    yield from load_time_marks(name, package)
    yield from frame_time_marks(name, package, [shot for some in shots.values() for shot in some])
    yield from fidelity_marks(name, package, shots)


def train_or_load(capture: Path, run: Path) -> Trainer:
    """Load the trainer that ia-ingest left in a folder; train it first if there is none."""
    if not (run / "checkpoint").exists():
        command = [sys.executable, "-m", "instant_avatar.ingest", str(capture), "--out", str(run)]
        command += ["--seconds", str(SECONDS), "--frames", f"0:{FRAMES}", "--overwrite"]
        subprocess.run(command, cwd=ROOT, stdout=sys.stderr, check=True)
    return checkpoint.load(run / "checkpoint")[0]


if __name__ == "__main__":
    sys.exit(main())

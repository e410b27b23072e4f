"""What ia-batch costs beside ia-ingest alone.

    python -m benchmarks.batch              # about 10 min on an idle machine of two cores

The same captures are learnt alone and in a batch, one at a time, in turns. Core-seconds are those
of the processes that learn; wall time has the start of Ray in it, and other programs must be idle.
"""

import json
import os
import resource
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import tyro

from benchmarks.hardware import ROOT, Hardware
from benchmarks.measurements import Measurement, markdown_rows
from instant_avatar.studio.shoot import ShootConfig, film_capture


@dataclass(frozen=True, kw_only=True)
class BatchBenchmark:
    """Measure the overhead of ia-batch."""

    captures: int = 6
    """Captures per batch."""
    rounds: int = 2
    """Repetitions of the comparison with ia-ingest."""
    steps: int = 300
    """Training steps per capture."""
    size: int = 128
    """Width and height of the frames, pixels."""


@dataclass(frozen=True, kw_only=True)
class Cost:
    """Wall time and CPU time, seconds."""

    wall_s: float
    core_s: float


def main() -> None:
    given, hardware = tyro.cli(BatchBenchmark), Hardware.here()
    environment = {**os.environ, "RAY_worker_niceness": "0", "PYTHONPATH": str(ROOT)}
    with TemporaryDirectory() as name:
        place = Path(name)
        film_capture(place / "film", ShootConfig(frames=40, size=given.size))
        films = copy_film(place, given.captures)
        marks = overhead(given, place, films, environment)
    print("\n".join([*hardware.lines(), "", *markdown_rows(marks)]))


def copy_film(place: Path, count: int) -> list[Path]:
    films = [place / "films" / f"film{number:02d}" for number in range(count)]
    for film in films:
        shutil.copytree(place / "film", film, ignore=shutil.ignore_patterns("truth"))
        (film / "notes.txt").write_text(film.name)
    return films


def run(command: list[str], environment: dict[str, str]) -> Cost:
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    core_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Cost(wall_s=time.perf_counter() - began, core_s=core_s)


def run_batch(films: list[Path], out: Path, steps: int, environment: dict[str, str]) -> Cost:
    """Learn captures one after the other: each takes all cores."""
    command = [sys.executable, "-m", "instant_avatar.batch", *map(str, films), "--out", str(out)]
    words = ["--threads", str(os.cpu_count()), "--steps", str(steps)]
    wall_s = run([*command, "--", *words], environment).wall_s
    lines = (out / "results.jsonl").read_text(encoding="utf-8").splitlines()
    return Cost(wall_s=wall_s, core_s=sum(json.loads(line)["core_s"] for line in lines))


def overhead(
    given: BatchBenchmark, place: Path, films: list[Path], environment: dict[str, str]
) -> list[Measurement]:
    """ia-ingest on each capture, then ia-batch on all of them, one at a time, in turns."""
    alone, batches = [], []
    words = ["--steps", str(given.steps), "--threads", str(os.cpu_count()), "--overwrite"]
    ingest = [sys.executable, "-m", "instant_avatar.ingest"]
    run([*ingest, str(films[0]), *words, "--out", str(place / "warm")], environment)
    for number in range(given.rounds):
        for film in films:
            out = place / "alone" / f"{film.name}-{number}"
            alone.append(run([*ingest, str(film), *words, "--out", str(out)], environment))
        batches.append(run_batch(films, place / f"batch{number}", given.steps, environment))
    count = given.rounds * len(films)
    cores = [sum(each.core_s for each in costs) / count for costs in (alone, batches)]
    walls = [sum(each.wall_s for each in costs) / count for costs in (alone, batches)]
    return [
        Measurement(name="ia-ingest alone, core-seconds per capture", value=cores[0]),
        Measurement(name="in ia-batch, core-seconds per capture", value=cores[1]),
        Measurement(
            name="overhead, % of core-seconds", value=100.0 * (cores[1] / cores[0] - 1.0),
            required="5", context=f"{count} captures each, one at a time",
        ),
        Measurement(
            name="overhead, % of wall time", value=100.0 * (walls[1] / walls[0] - 1.0),
            required="5", context="other programs count",
        ),
    ]  # fmt: skip


if __name__ == "__main__":
    main()

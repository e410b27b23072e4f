"""How soon training starts, and how much memory a long video takes: processes of their own."""

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.hardware import ROOT
from benchmarks.measurements import Measurement

STARTS = 3
MEMORY_SECONDS = 30.0


def measure_startup(capture: Path) -> Iterator[Measurement]:
    """From the start of a process to its first step; compiled code lies on the disk already."""
    first_step(capture)
    starts = [first_step(capture) for _ in range(STARTS)]
    whole, after_reading = (statistics.median(times) for times in zip(*starts, strict=True))
    yield Measurement(
        name="start-up to the first step, compiled code cached, s",
        value=whole,
        required="≤ 6",
        stretch_goal="≤ 1.5",
        context=f"wall, median of {STARTS} processes: interpreter, imports, body, kernels; of that "
        f"{after_reading:.2f} s from the opening of the video to the end of the first step",
    )


def first_step(capture: Path) -> tuple[float, float]:
    """Seconds from the process's start, and from the video's opening, to the first step's end."""
    command = [sys.executable, "-m", "benchmarks.first_step", str(capture), str(time.time())]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
    whole, after_reading = done.stdout.split()
    return float(whole), float(after_reading)


def measure_peak_memory(capture: Path, run: Path) -> Iterator[Measurement]:
    """The peak of a whole ia-ingest."""
    report = run_ingest(capture, run)
    training = report["training"]
    yield Measurement(
        name="peak memory of ia-ingest, 300 frames of 540 px, GiB",
        value=training["peak_memory_mb"] / 1024.0,
        required="≤ 4",
        stretch_goal="≤ 2",
        context=f"resident, package and checks included; {MEMORY_SECONDS:.0f} s of training; "
        f"its own start-up, without imports: {training['startup_seconds']:.2f} s",
    )


def run_ingest(capture: Path, run: Path) -> dict[str, Any]:
    """Runs ia-ingest; its report."""
    command = [sys.executable, "-m", "instant_avatar.ingest", str(capture / "video.mp4")]
    command += ["--poses", str(capture / "poses.npz"), "--out", str(run), "--overwrite"]
    command += ["--seconds", str(MEMORY_SECONDS)]
    subprocess.run(command, cwd=ROOT, stdout=sys.stderr, check=False)
    return json.loads((run / "report.json").read_text())

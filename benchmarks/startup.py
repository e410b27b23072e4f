"""How soon training starts, in processes of their own."""

import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from baselines.hardware import ROOT
from benchmarks.measurements import Measurement

STARTS = 3


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

"""A run that is killed at a random moment, looked at, and resumed."""

import json
import random
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from avatar.training import checkpoint
from benchmarks.hardware import ROOT
from benchmarks.measurements import Measurement
from export.player import Player

SECONDS = 15.0


class ResumedRun(NamedTuple):
    """What became of a killed run.

    Attributes:
        unreadable: Files that could not be read right after the kill.
        code: How the resumed run ended.
        psnr: Of its held-out frames, dB.
        training_seconds: That the checkpoint held.
    """

    unreadable: tuple[str, ...]
    code: int
    psnr: float
    training_seconds: float


def ingest_command(capture: Path, run: Path, *more: str) -> list[str]:
    """ia-ingest on a small capture."""
    words = [sys.executable, "-m", "instant_avatar.ingest", str(capture), "--out", str(run)]
    return [*words, "--seconds", str(SECONDS), *more]


def run_to_end(capture: Path, run: Path, *more: str) -> tuple[int, float, float]:
    """A run to its end: exit code, held-out PSNR, and how long it took."""
    began = time.perf_counter()
    done = subprocess.run(
        ingest_command(capture, run, *more), cwd=ROOT, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL, check=False,
    )  # fmt: skip
    took = time.perf_counter() - began
    try:
        psnr = json.loads((run / "report.json").read_text())["held_out"]["psnr"]
    except (OSError, ValueError):
        psnr = float("nan")
    return done.returncode, psnr, took


def kill_and_resume(capture: Path, run: Path, after_s: float) -> ResumedRun:
    """Kill a run after some seconds, read what it left, and resume it."""
    with subprocess.Popen(
        ingest_command(capture, run), cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        time.sleep(after_s)
        process.kill()
    unreadable, had_s = list[str](), 0.0
    for path in (p for p in run.rglob("*") if p.is_file() and not p.name.startswith(".")):
        try:
            if path.name == "state.pt":
                had_s = checkpoint.load(path.parent)[0].wall_seconds
            elif path.suffix == ".iavatar":
                Player.load(path)
            elif path.name == "report.json":
                json.loads(path.read_text())
        except Exception as error:  # whatever it is, it must not be
            unreadable.append(f"{path.name}: {error}")
    code, psnr, _ = run_to_end(capture, run, *(["--resume"] if run.exists() else []))
    return ResumedRun(tuple(unreadable), code, psnr, had_s)


def measure_kills(capture: Path, folder: Path, *, kills: int) -> Iterator[Measurement]:
    """Kill the run at this many moments, spread at random over its whole length."""
    _, unbroken, whole_s = run_to_end(capture, folder / "unbroken")
    _, unbroken, whole_s = run_to_end(capture, folder / "again")  # compiled code is kept now
    chance, ended = random.Random(0), list[ResumedRun]()
    for number in range(kills):
        after_s = chance.uniform(0.0, whole_s)
        survivor = kill_and_resume(capture, folder / f"{number}", after_s)
        ended.append(survivor)
        print(f"  killed after {after_s:.1f} of {whole_s:.1f} s: {survivor}", file=sys.stderr)
        shutil.rmtree(folder / f"{number}", ignore_errors=True)
    well = [s for s in ended if s.code == 0 and not s.unreadable]
    psnr = [s.psnr for s in ended if s.code == 0]
    yield Measurement(
        name=f"killed {kills} times at random moments, resumed to the end",
        value=float(len(well)),
        required=f"{kills}",
        stretch_goal="± 0.2 dB",
        context=f"{sum(len(s.unreadable) for s in ended)} unreadable files; unbroken run "
        f"{unbroken:.2f} dB, resumed ones {min(psnr, default=float('nan')):.2f} to "
        f"{max(psnr, default=float('nan')):.2f}, median "
        f"{statistics.median(psnr) if psnr else float('nan'):.2f}",
    )

"""How training scales with threads: wall and core time of a step, and what the machine could give.

Slices of steps take turns at each number of threads in one process. Two processes of one thread
each, against one of them alone, show how much faster the machine is with two of its cores: memory
and caches are shared, and a virtual core may be half a real one.
"""

import multiprocessing
import os
import statistics
import time
from collections.abc import Iterator
from pathlib import Path

import numba
import numpy as np
import torch

from avatar.rig import Rig
from avatar.training.trainer import Trainer
from benchmarks.measurements import Measurement
from benchmarks.sample_training import load_trainer, open_sample, training_config

FIRST_STEPS = 900
"""Steps before any is timed: the fog clears, samples become few, and the means of gradients that
have ended reach the smallest numbers there are, which processors are slow at."""
STEPS_PER_SLICE = 48
SLICES = 6
MANY_CORES = 8
"""Cores of a desk for which the speed is calculated by Amdahl's law."""
PHONE_UNCERTAINTY = 1.0
"""Poses of a phone's video are estimates: they are corrected, and all priors are on."""


def scaling_marks(capture: Path) -> Iterator[Measurement]:
    """Rows of a step on one and on all threads, and of two runs at once."""
    trainer, most = trained_on(capture), numba.get_num_threads()
    wall, core = time_slices(trainer, sorted({1, most}))
    speed = wall[1] / wall[most]
    serial = (most / speed - 1.0) / max(most - 1.0, 1.0) if most > 1 else 1.0
    eight = 1.0 / (serial + (1.0 - serial) / MANY_CORES)
    limit = two_runs_at_once(capture)
    yield Measurement(
        name=f"{most} threads to one, training, times as fast", value=speed,
        required="1.45", stretch_goal="1.6",
        context=f"{wall[1]:.1f} and {wall[most]:.1f} wall ms a step; two runs of one thread at "
        f"once: {limit:.2f} times as fast as one after the other",
    )  # fmt: skip
    yield Measurement(
        name=f"core time of {most} threads to one", value=core[most] / core[1],
        required="1.05", stretch_goal="1.0",
        context=f"{core[1]:.1f} and {core[most]:.1f} core-ms a step",
    )  # fmt: skip
    yield Measurement(
        name=f"{MANY_CORES} cores to one, calculated, times as fast", value=eight,
        required="4.5", stretch_goal="7",
        context=f"{100 * (1.0 - serial):.0f} % of a step is parallel, by the first row",
    )  # fmt: skip


def trained_on(capture: Path) -> Trainer:
    """A trainer that has taken in a capture and made the first steps."""
    recording = open_sample(capture)
    config = training_config(recording, 60.0, pose_uncertainty=PHONE_UNCERTAINTY)
    trainer = load_trainer(recording, Rig.from_shaped_body(recording.shaped), config).trainer
    make_steps(trainer, FIRST_STEPS)
    return trainer


def make_steps(trainer: Trainer, count: int) -> None:
    """Steps at the constant rate of a video that still plays."""
    for _ in range(count):
        trainer.step(rate=0.5, hard_surface_share=1.0, pose_rate=0.5)


def time_slices(trainer: Trainer, threads: list[int]) -> tuple[dict[int, float], dict[int, float]]:
    """Median wall and core milliseconds of a step, by the number of threads."""
    wall = {number: list[float]() for number in threads}
    core = {number: list[float]() for number in threads}
    torch.set_num_threads(1)
    for turn in range(SLICES + 1):
        for number in threads:
            numba.set_num_threads(number)
            began, began_core = time.perf_counter(), time.process_time()
            make_steps(trainer, STEPS_PER_SLICE)
            if turn:  # the first wakes the threads
                wall[number].append(1e3 * (time.perf_counter() - began) / STEPS_PER_SLICE)
                core[number].append(1e3 * (time.process_time() - began_core) / STEPS_PER_SLICE)
    return (
        {number: statistics.median(times) for number, times in wall.items()},
        {number: statistics.median(times) for number, times in core.items()},
    )


def two_runs_at_once(capture: Path) -> float:
    """How much faster two runs are at once than one after the other."""
    alone = _wall_ms_of_runs(capture, 1)
    together = _wall_ms_of_runs(capture, 2)
    return 2.0 * alone / together


def _wall_ms_of_runs(capture: Path, runs: int) -> float:
    """Mean wall milliseconds of a step of runs in processes of their own, one thread each."""
    context = multiprocessing.get_context("spawn")
    barrier, times = context.Barrier(runs), context.Queue()
    workers = [
        context.Process(target=_run_alone, args=(capture, barrier, times)) for _ in range(runs)
    ]
    for worker in workers:
        worker.start()
    found = [times.get() for _ in workers]
    for worker in workers:
        worker.join()
    return float(np.mean(found))


def _run_alone(capture: Path, barrier, times) -> None:
    os.environ["OMP_NUM_THREADS"] = "1"
    numba.set_num_threads(1)
    trainer = trained_on(capture)
    barrier.wait()
    wall, _ = time_slices(trainer, [1])
    times.put(wall[1])

"""How training scales with threads: wall and core time of a step, and what the machine could give.

Slices of steps take turns at each number of threads in one process. Two processes of one thread
each, against one of them alone, show how much faster the machine is with two of its cores: memory
and caches are shared, and a virtual core may be half a real one. For cores that are not there, each
thread's share of a kernel is timed alone: the longest shares, the waking of threads and what is not
shared add up to a step.
"""

import multiprocessing
import os
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numba
import numpy as np
import torch

from avatar.kernels import operations
from avatar.kernels.threads import run_threads
from avatar.rig import Rig
from avatar.training import pose_correction, replay_buffer
from avatar.training.trainer import Trainer
from benchmarks.measurements import Measurement
from benchmarks.sample_training import load_trainer, open_sample, training_config

FIRST_STEPS = 900
"""Steps before any is timed: the fog clears, samples become few, and the means of gradients that
have ended reach the smallest numbers there are, which processors are slow at."""
STEPS_PER_SLICE = 48
SLICES = 6
MANY_CORES = 8
"""Cores of a desk for which the speed is calculated."""
PHONE_UNCERTAINTY = 1.0
"""Poses of a phone's video are estimates: they are corrected, and all priors are on."""


def scaling_marks(capture: Path) -> Iterator[Measurement]:
    """Rows of a step on one and on all threads, and of two runs at once."""
    trainer, most = trained_on(capture), numba.get_num_threads()
    wall, core = time_slices(trainer, sorted({1, most}))
    speed = wall[1] / wall[most]
    eight, shared = calculate_many_cores(capture)
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
        context=f"{100 * shared:.0f} % of a step is in shares of kernels, each timed alone",
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


def calculate_many_cores(capture: Path) -> tuple[float, float]:
    """How much faster a step is on `MANY_CORES` than on one, and the share that kernels share.

    Memory is taken to serve as many cores as there are, so this is an upper bound.
    """
    context = multiprocessing.get_context("spawn")
    results = context.Queue()
    with patch.dict(os.environ, NUMBA_NUM_THREADS=str(MANY_CORES)):
        worker = context.Process(target=_time_shares, args=(capture, waking_seconds(), results))
        worker.start()
    found = results.get()
    worker.join()
    return found


def waking_seconds() -> float:
    """Seconds that a kernel without work takes on two threads."""
    times = []
    numba.set_num_threads(min(2, numba.get_num_threads()))
    for _ in range(200):
        began = time.perf_counter()
        run_threads(lambda thread, threads: None)
        times.append(time.perf_counter() - began)
        time.sleep(1e-3)
    return statistics.median(times)


def _time_shares(capture: Path, waking: float, results) -> None:
    """Puts speed and shared part into a queue: medians, over steps, of each thread's shares.

    A longest share of single steps would be one that the machine's other work held up. Blocks that
    threads claim are dealt out in turn.
    """
    numba.set_num_threads(1)
    trainer = trained_on(capture)
    numba.set_num_threads(MANY_CORES)
    torch.set_num_threads(1)
    shares = defaultdict[str, list[np.ndarray]](list)

    def time_each(kernel: Callable[..., Any], arguments: list[tuple[Any, ...]]) -> None:
        marks = [time.perf_counter()]
        torch.set_flush_denormal(True)
        for own in arguments:
            kernel(*own)
            marks.append(time.perf_counter())
        torch.set_flush_denormal(False)
        shares[kernel.__name__].append(np.diff(marks))

    def threads_in_turn(kernel: Callable[..., Any], *arguments: Any) -> None:
        time_each(kernel, [(thread, MANY_CORES, *arguments) for thread in range(MANY_CORES)])

    def blocks_in_turn(kernel: Callable[..., Any], *arguments: Any) -> None:
        dealt = (np.array([thread, MANY_CORES]) for thread in range(MANY_CORES))
        time_each(kernel, [(blocks, *arguments) for blocks in dealt])

    for module in (operations, pose_correction, replay_buffer):
        patch.object(module, "run_threads", threads_in_turn).start()
    patch.object(operations, "run_blocks", blocks_in_turn).start()
    make_steps(trainer, STEPS_PER_SLICE)
    shares.clear()
    count = SLICES * STEPS_PER_SLICE
    began = time.perf_counter()
    make_steps(trainer, count)
    wall = (time.perf_counter() - began) / count
    serial = wall - sum(float(np.sum(each)) for each in shares.values()) / count
    medians = [(len(each) / count, np.median(each, axis=0)) for each in shares.values()]
    shared = sum(calls * float(each.sum()) for calls, each in medians)
    longest = sum(calls * (float(each.max()) + waking) for calls, each in medians)
    results.put(((serial + shared) / (serial + longest), shared / (serial + shared)))


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

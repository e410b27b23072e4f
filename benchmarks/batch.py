"""What ia-batch costs beside ia-ingest alone, and what a second node of one core adds.

    python -m benchmarks.batch              # about 20 min on an idle machine of two cores
    python -m benchmarks.batch --captures 2 --rounds 1 --no-scaling

Costs are core-seconds of whole process trees; the same captures are learnt alone and in a batch in
turns. Scaling is measured by wall time on local Ray clusters of one-core nodes, so that other
programs must be idle; the share of the time in which the nodes were busy depends less on them.
"""

import json
import os
import resource
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import tyro

from benchmarks.hardware import ROOT, Hardware
from benchmarks.measurements import Measurement, markdown_rows
from studio.shoot import ShootConfig, film_capture

ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "NUMBA", "MKL", "OPENBLAS")}


@dataclass(frozen=True, kw_only=True)
class BatchBenchmark:
    """Measure overhead and scaling of ia-batch."""

    captures: int = 6
    """Captures per node and batch."""
    rounds: int = 2
    """Repetitions of the comparison with ia-ingest."""
    steps: int = 300
    """Training steps per capture."""
    size: int = 128
    """Width and height of the frames, pixels."""
    scaling: bool = True
    """Measure one and two nodes of a Ray cluster."""


@dataclass(frozen=True, kw_only=True)
class Cost:
    """Wall time and CPU time, seconds."""

    wall_s: float
    core_s: float


def main() -> None:
    given, hardware = tyro.cli(BatchBenchmark), Hardware.here()
    environment = {**os.environ, **ONE_THREAD, "PYTHONPATH": str(ROOT)}
    with TemporaryDirectory() as name:
        place = Path(name)
        film_capture(place / "film", ShootConfig(frames=40, size=given.size))
        films = copy_film(place, 2 * given.captures)
        marks = overhead(given, place, films[: given.captures], environment)
        if given.scaling:
            marks += scaling(given, place, films, environment)
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


def batch_command(films: list[Path], out: Path, steps: int, *words: str) -> list[str]:
    places = [str(film) for film in films]
    own = [sys.executable, "-m", "apps.batch", *places, "--out", str(out), "--cores", "1"]
    return [*own, "--scratch", str(out.parent / "work"), *words, "--", "--steps", str(steps)]


def overhead(
    given: BatchBenchmark, place: Path, films: list[Path], environment: dict[str, str]
) -> list[Measurement]:
    """ia-ingest on each capture, then ia-batch on all of them, one at a time, in turns."""
    alone, batches = [], []
    words = ["--steps", str(given.steps), "--threads", "1", "--overwrite"]
    ingest = [sys.executable, "-m", "apps.ingest"]
    run([*ingest, str(films[0]), *words, "--out", str(place / "warm")], environment)
    for number in range(given.rounds):
        for film in films:
            out = place / "alone" / f"{film.name}-{number}"
            alone.append(run([*ingest, str(film), *words, "--out", str(out)], environment))
        command = batch_command(films, place / f"batch{number}", given.steps, "--at-once", "1")
        batches.append(run(command, environment))
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


def scaling(
    given: BatchBenchmark, place: Path, films: list[Path], environment: dict[str, str]
) -> list[Measurement]:
    """Captures per second on one and on two nodes of one core."""
    rates, busy = {}, {}
    for nodes in (1, 2):
        out = place / f"nodes{nodes}"
        rates[nodes], busy[nodes] = learn_on_cluster(
            nodes, films[: nodes * given.captures], out, given.steps, environment
        )
    marks = [
        Measurement(name=f"{nodes} node(s), captures per minute", value=60.0 * rates[nodes])
        for nodes in rates
    ]
    marks += [
        Measurement(
            name=f"{nodes} node(s), share of the time that they were busy", value=busy[nodes],
            required="0.9",
        )
        for nodes in busy
    ]  # fmt: skip
    ratio, possible = rates[2] / rates[1], two_processes(given, place, films[:2], environment)
    return [
        *marks,
        Measurement(name="2 nodes to 1 node", value=ratio, required="1.8"),
        Measurement(
            name="two processes to one, without a scheduler", value=possible,
            context="what the cores themselves gain: they share caches and memory",
        ),
        Measurement(name="2 nodes to 1 node, of that", value=ratio / possible),
    ]  # fmt: skip


def two_processes(
    given: BatchBenchmark, place: Path, films: list[Path], environment: dict[str, str]
) -> float:
    """Return how many times as fast two captures are learnt at once as one after the other."""
    words = ["--steps", str(given.steps), "--threads", "1", "--overwrite"]
    ingest = [sys.executable, "-m", "apps.ingest"]
    commands = [[*ingest, str(f), *words, "--out", str(place / "two" / f.name)] for f in films]
    after_another = sum(run(command, environment).wall_s for command in commands)
    began = time.perf_counter()
    with ThreadPoolExecutor(len(films)) as executor:
        list(executor.map(lambda command: run(command, environment), commands))
    return after_another / (time.perf_counter() - began)


def learn_on_cluster(
    nodes: int, films: list[Path], out: Path, steps: int, environment: dict[str, str]
) -> tuple[float, float]:
    """Return captures per second from the first start to the last end, and the share busy."""
    os.environ.update(environment, RAY_USAGE_STATS_ENABLED="0")
    from ray.cluster_utils import Cluster

    size = {"object_store_memory": 100_000_000, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **size})
    try:
        for _ in range(nodes):
            cluster.add_node(num_cpus=1, memory=4_000_000_000, **size)
        run(batch_command(films, out, steps, "--ray", str(cluster.address)), environment)
    finally:
        cluster.shutdown()
    lines = (out / "results.jsonl").read_text(encoding="utf-8").splitlines()
    records = [json.loads(line) for line in lines]
    began = min(record["ended"] - record["wall_s"] for record in records)
    wall_s = max(record["ended"] for record in records) - began
    busy = sum(record["wall_s"] for record in records) / (nodes * wall_s)
    return len(records) / wall_s, busy


if __name__ == "__main__":
    main()

"""What baking takes, and what the package weighs.

How long the player takes: for a picture, and from its file to the first one.
"""

import subprocess
import sys
import time
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avatar.training.trainer import Trainer
from baselines.hardware import ROOT
from benchmarks.measurements import Measurement
from benchmarks.player_fidelity import ComparedView
from export.package.player_tables import QUALITY_TIERS
from export.player import Player
from instant_avatar.animation.player_checks import PlayerTiming, benchmark_player
from instant_avatar.run.snapshot_writer import write_packages

MB = 1e6


@dataclass(frozen=True, kw_only=True)
class BakeTime:
    """Seconds from a trained avatar to its package under its name, checks included."""

    cpu_s: float
    wall_s: float


def time_bake(trainer: Trainer, package: Path, shots: Sequence[ComparedView]) -> BakeTime:
    """Writes the package of an avatar.

    The first time compiles kernels or loads them from disk; the second is measured.

    Raises:
        ExportRefused: If it is too blurred for one.
    """
    views = [(shot.pose, shot.camera) for shot in shots]
    for _ in range(2):
        cpu, wall = time.process_time(), time.perf_counter()
        list(write_packages(trainer, package, views, curve_point=None))
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    return BakeTime(cpu_s=cpu, wall_s=wall)


def package_marks(name: str, package: Path, bake: BakeTime) -> Iterator[Measurement]:
    """Seconds and bytes."""
    with zipfile.ZipFile(package) as archive:
        sizes = {info.filename: info.compress_size for info in archive.infolist()}
    tables = sum(size for entry, size in sizes.items() if entry.startswith("hq/"))
    tables += sizes["player.onnx"]
    largest = sorted(sizes.items(), key=lambda item: -item[1])[:3]
    yield Measurement(
        name=f"{name}: baking, checking and writing, s wall",
        value=bake.wall_s,
        required="≤ 20",
        stretch_goal="≤ 5",
        context=f"CPU {bake.cpu_s:.1f} s; torch and numba on one thread",
    )
    yield Measurement(
        name=f"{name}: the HQ tier in the package, MB",
        value=tables / MB,
        required="≤ 5.5",
        context=", ".join(f"{entry} {size / MB:.2f}" for entry, size in largest),
    )
    yield Measurement(
        name=f"{name}: the whole file, MB",
        value=package.stat().st_size / MB,
        required="≤ 7.5",
        stretch_goal="< 3.6",
    )


ROUNDS = 5
TARGETS = {"hq": ("≤ 45", "≤ 25"), "lite": ("≤ 28", "≤ 15")}
FIRST_IMAGE_SCRIPT = """
import sys, time
import numpy as np
import onnxruntime
from capture.camera import Camera
from export.player import Player
from preprocess.body.body_pose import BodyPose
camera = Camera(focal_px=(810.0, 810.0), center_px=(270.0, 270.0), size_px=(540, 540),
                camera_from_world=np.diag([1.0, -1, -1, 1]) + 3 * np.eye(4, k=1)[[3, 3, 2, 3]])
began = time.process_time()
player = Player.load(sys.argv[1], tier=sys.argv[2])
loaded = time.process_time()
player.render(BodyPose.rest(), camera)
print(loaded - began, time.process_time() - began)
"""
"""Its own process: nothing has been loaded, compiled or cached before."""


def frame_time_marks(
    name: str, package: Path, shots: Sequence[ComparedView]
) -> Iterator[Measurement]:
    """CPU time of a picture, and its ratio to the reference graph's, tiers in turns."""
    players = {tier: Player.load(package, tier=tier) for tier in QUALITY_TIERS}
    seen = [(shot.pose, shot.camera) for shot in shots]
    rounds: dict[str, list[PlayerTiming]] = {tier: [] for tier in players}
    for _ in range(ROUNDS):
        for tier, player in players.items():
            rounds[tier].append(benchmark_player(player, seen, tier=tier, load_ms=0.0))
    for tier, found in rounds.items():
        least, moonshot = TARGETS[tier]
        ms = float(np.median([turn.cpu_ms_per_frame for turn in found]))
        reference = [turn.reference_ms for turn in found]
        ratio = np.median([turn.cpu_ms_per_frame / turn.reference_ms for turn in found])
        yield Measurement(
            name=f"{name}, {tier}: CPU-ms a picture of {found[0].size} px, one thread",
            value=ms,
            required=least,
            stretch_goal=moonshot,
            context=f"{found[0].pixels_covered:.1%} covered; {len(seen)} pictures, {ROUNDS} times: "
            f"{min(t.cpu_ms_per_frame for t in found):.1f} to "
            f"{max(t.cpu_ms_per_frame for t in found):.1f}",
        )
        yield Measurement(
            name=f"{name}, {tier}: the same in runs of the reference graph",
            value=float(ratio),
            context=f"which takes {min(reference):.1f} to {max(reference):.1f} ms",
        )


def load_time_marks(name: str, package: Path) -> Iterator[Measurement]:
    """From the file to the first picture, in a fresh process whose imports are done."""
    for tier in QUALITY_TIERS:
        times = [_time_first_image(package, tier) for _ in range(3)]
        loaded, drawn = (float(value) for value in np.median(times, axis=0))
        yield Measurement(
            name=f"{name}, {tier}: from the file to the first picture, CPU-s",
            value=drawn,
            required="≤ 0.8",
            stretch_goal="≤ 0.3",
            context=f"reading and session {loaded:.2f} s; a process of its own, median of 3",
        )


def _time_first_image(package: Path, tier: str) -> list[float]:
    command = [sys.executable, "-c", FIRST_IMAGE_SCRIPT, str(package), tier]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return [float(number) for number in done.stdout.split()]

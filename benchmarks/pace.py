"""How long the player takes: for a picture, and from its file to the first one."""

import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from apps.playing.bench import PlayerTiming, benchmark_player
from benchmarks.hardware import ROOT
from benchmarks.likeness import ComparedView
from benchmarks.marks import Measurement
from export.player import Player
from export.tiers import QUALITY_TIERS

ROUNDS = 5
TARGETS = {"hq": ("≤ 45", "≤ 25"), "lite": ("≤ 28", "≤ 15")}
FIRST_IMAGE_SCRIPT = """
import sys, time
import numpy as np
import onnxruntime
from capture.camera import Camera
from export.player import Player
from preprocess.pose import BodyPose
camera = Camera(focal_px=(810.0, 810.0), center_px=(270.0, 270.0), size_px=(540, 540),
                camera_from_world=np.diag([1.0, -1, -1, 1]) + 3 * np.eye(4, k=1)[[3, 3, 2, 3]])
began = time.process_time()
player = Player.load(sys.argv[1], tier=sys.argv[2])
loaded = time.process_time()
player.render(BodyPose.rest(), camera)
print(loaded - began, time.process_time() - began)
"""
"""Its own process: nothing has been loaded, compiled or cached before."""


def frame_time_marks(name: str, package: Path, shots: Sequence[ComparedView]) -> Iterator[Measurement]:
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

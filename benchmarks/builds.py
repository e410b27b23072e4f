"""CPU time of one frame's warp cells, in processes of their own.

    python -m benchmarks.builds CAPTURE

How many threads numpy's BLAS has is decided when it is loaded, and one that waits spins: so the
build is timed once with a single thread and once as it is when nobody asks.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import torch

from avatar.cells import WarpCells
from avatar.rig import Rig
from benchmarks.hardware import ROOT
from benchmarks.marks import Mark
from benchmarks.stage import opened
from benchmarks.stopwatch import interleaved
from preprocess.pose_file import read_motion

BANDS_M = (0.08, 0.15)
SOUGHT_M = 0.14
"""Roots farther from the skin than this are not sought, however wide the band."""
ROUNDS = 15


def main() -> None:
    print(json.dumps(built(Path(sys.argv[1]))))


def built(capture: Path) -> dict[str, float]:
    """Milliseconds of CPU time in two poses, and how many roots there are, for each band."""
    recording = opened(capture)
    rig = Rig.of(recording.shaped)
    novel = read_motion(capture / "truth" / "novel" / "poses.npz")
    poses = {
        "training": recording.motion[len(recording.motion) // 3].joint_rotations,
        "novel": novel[len(novel) // 2].joint_rotations,
    }
    work = {
        f"{name} {band_m}": lambda pose=pose, band_m=band_m: WarpCells.of(rig, pose, band_m=band_m)
        for name, pose in poses.items()
        for band_m in BANDS_M
    }
    times = interleaved(work, torch.device("cpu"), rounds=ROUNDS)
    roots = {
        f"roots {band_m}": float(len(WarpCells.of(rig, poses["training"], band_m=band_m).roots))
        for band_m in BANDS_M
    }
    return {name: 1000.0 * time for name, time in times.items()} | roots


def build_marks(capture: Path) -> list[Mark]:
    """One row for each band."""
    single, usual = _apart(capture, {"OPENBLAS_NUM_THREADS": "1"}), _apart(capture, {})
    marks = []
    for band_m, least, moonshot in zip(BANDS_M, ("≤ 30", "printed"), ("≤ 12", ""), strict=True):
        note = f"; roots beyond {100 * SOUGHT_M:.0f} cm are not sought" if band_m > SOUGHT_M else ""
        marks.append(
            Mark(
                name=f"build of a frame's cells, {100 * band_m:.0f}-cm band, core-ms",
                value=single[f"training {band_m}"],
                least=least,
                moonshot=moonshot,
                beside=f"training pose, {single[f'roots {band_m}']:,.0f} roots, BLAS with one "
                f"thread ({usual[f'training {band_m}']:.0f} ms with as many as it takes by "
                f"itself: they spin); novel pose {single[f'novel {band_m}']:.1f} ms{note}",
            )
        )
    return marks


def _apart(capture: Path, more: dict[str, str]) -> dict[str, float]:
    command = [sys.executable, "-m", "benchmarks.builds", str(capture)]
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | more, stdout=subprocess.PIPE, text=True, check=True
    )
    return json.loads(done.stdout)


if __name__ == "__main__":
    main()

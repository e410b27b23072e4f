"""CPU time of one frame's warp cells, in a process of its own.

python -m benchmarks.builds CAPTURE
"""

import json
import subprocess
import sys
from pathlib import Path

from avatar.correspondence_grid import CorrespondenceGrid
from avatar.rig import Rig
from benchmarks.hardware import ROOT
from benchmarks.measurements import Measurement
from benchmarks.sample_training import open_sample
from benchmarks.stopwatch import time_interleaved
from preprocess.poses.pose_format_registry import read_poses

BANDS_M = (0.08, 0.15)
ROUNDS = 15


def main() -> None:
    print(json.dumps(built(Path(sys.argv[1]))))


def built(capture: Path) -> dict[str, float]:
    """Milliseconds of CPU time in two poses, and how many roots there are, for each band."""
    recording = open_sample(capture)
    rig = Rig.from_shaped_body(recording.shaped)
    novel = read_poses(capture / "truth" / "novel" / "poses.npz")
    poses = {
        "training": recording.motion[len(recording.motion) // 3].joint_rotations,
        "novel": novel[len(novel) // 2].joint_rotations,
    }
    work = {
        f"{name} {band_m}": lambda pose=pose, band_m=band_m: CorrespondenceGrid.solve(
            rig, pose, band_m=band_m
        )
        for name, pose in poses.items()
        for band_m in BANDS_M
    }
    times = time_interleaved(work, rounds=ROUNDS)
    roots = {
        f"roots {band_m}": float(
            (CorrespondenceGrid.solve(rig, poses["training"], band_m=band_m).packed_cells & 3).sum()
        )
        for band_m in BANDS_M
    }
    return {name: 1000.0 * time for name, time in times.items()} | roots


def build_marks(capture: Path) -> list[Measurement]:
    """One row for each band."""
    told = _apart(capture)
    marks = []
    for band_m, least, moonshot in zip(BANDS_M, ("≤ 30", "printed"), ("≤ 12", ""), strict=True):
        marks.append(
            Measurement(
                name=f"build of a frame's cells, {100 * band_m:.0f}-cm band, core-ms",
                value=told[f"training {band_m}"],
                required=least,
                stretch_goal=moonshot,
                context=f"training pose, {told[f'roots {band_m}']:,.0f} roots; novel pose "
                f"{told[f'novel {band_m}']:.1f} ms",
            )
        )
    return marks


def _apart(capture: Path) -> dict[str, float]:
    command = [sys.executable, "-m", "benchmarks.builds", str(capture)]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout)


if __name__ == "__main__":
    main()

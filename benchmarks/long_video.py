"""A clip played again and again: what a long video costs in memory.

python -m benchmarks.long_video CAPTURE RUN     (the process that is measured)
"""

import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from avatar.training.train import warm_up
from benchmarks.hardware import ROOT
from benchmarks.measurements import Measurement
from benchmarks.sample_training import open_sample
from capture.source_opening import open_source
from instant_avatar.run.run_folder import RunFolder
from preprocess.body.body_pose import Motion
from preprocess.poses.pose_file import write_motion
from preprocess.poses.pose_format_registry import read_poses

LOOPS = 5
FIRST, LAST = 300, 3000
SECONDS = 60.0
MIB = 1 << 20


def write_looped_capture(capture: Path, out: Path) -> Path:
    """A capture folder that holds another's frames several times over."""
    if out.exists():
        return out
    part = out.with_name(out.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    (part / "masks").mkdir(parents=True)
    source = open_source(capture)
    frames = [cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR) for frame in source.frames()]
    code = cv2.VideoWriter.fourcc(*"FFV1")
    video = cv2.VideoWriter(str(part / "video.mkv"), code, 30.0, source.size_px)
    masks = sorted((capture / "masks").iterdir())
    for number in range(LOOPS * len(frames)):
        video.write(frames[number % len(frames)])
        (part / "masks" / f"{number:06d}.png").hardlink_to(masks[number % len(frames)])
    video.release()
    shutil.copy(capture / "cameras.npz", part)
    motion = read_poses(capture / "poses.npz")
    rows = np.tile(np.arange(len(motion)), LOOPS)
    repeated: dict[str, Any] = {
        item.name: getattr(motion, item.name)[rows]
        for item in fields(Motion)
        if item.name in ("root_rotations", "root_translations", "joint_rotations", "valid")
    }
    write_motion(part / "poses.npz", replace(motion, frames=None, times_s=None, **repeated))
    part.rename(out)
    return out


def measure_memory_growth(capture: Path, looped: Path) -> Iterator[Measurement]:
    """Memory of a process that learns from the looped clip."""
    long = write_looped_capture(capture, looped)
    command = [sys.executable, "-m", "benchmarks.long_video", str(long), str(long / "run")]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
    first, last, read = (float(word) for word in done.stdout.split()[-3:])
    yield Measurement(
        name=f"memory growth from frame {FIRST} to frame {LAST:,}, MiB",
        value=(last - first) / MIB,
        required="≤ 100",
        stretch_goal="≤ 20",
        context=f"resident: {first / MIB:.0f} MiB at the first, {last / MIB:.0f} at the last; "
        f"{read:.0f} frames read as fast as the trainer takes them",
    )


def resident_bytes() -> int:
    """Bytes of this process that are in memory now (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def main() -> None:
    """Learns, and prints what was resident at two frames, and how many were read."""

    from instant_avatar.run.session_events import PackageWritten
    from instant_avatar.run.session_start import new_trainer
    from instant_avatar.run.training_session import TrainingSession
    from preprocess.observation_source import RecordedObservations

    capture, run = Path(sys.argv[1]), RunFolder(path=Path(sys.argv[2]))
    recording = open_sample(capture)
    trainer = new_trainer(recording, seconds=SECONDS, seed=0, refine_poses=True)
    warm_up(trainer)
    at: dict[int, int] = {}
    add = trainer.add_frame

    def counted(*arguments: Any, **more: Any) -> None:
        add(*arguments, **more)
        at[lesson.meter.frames_read] = resident_bytes()

    trainer.add_frame = counted
    lesson = TrainingSession(trainer, RecordedObservations(recording), run, threading.Event(), {})
    with closing(lesson.run()) as events:
        next(event for event in events if isinstance(event, PackageWritten))
    shutil.rmtree(run.path, ignore_errors=True)
    early = min((count for count in at if count >= FIRST), default=max(at))
    print(at[early], at[max(at)], lesson.meter.frames_read)


if __name__ == "__main__":
    main()

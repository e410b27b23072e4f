"""What baking takes, and what the package weighs."""

import time
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from apps.learning.snapshot import write_package_snapshot
from avatar.trainer import Trainer
from benchmarks.likeness import ComparedView
from benchmarks.marks import Measurement
from export.errors import ExportRefused

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
        taken = write_package_snapshot(trainer, package, views, curve_point=None)
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        if taken.export_report is None:
            raise ExportRefused(str(taken.refusal))
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

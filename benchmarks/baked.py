"""What baking takes, and what the package weighs."""

import time
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from apps.learning.snapshot import snapshot
from avatar.trainer import Trainer
from benchmarks.likeness import Shot
from benchmarks.marks import Mark
from export.errors import ExportRefused

MB = 1e6


@dataclass(frozen=True, kw_only=True)
class Baked:
    """Seconds from a trained avatar to its package under its name, checks included."""

    cpu_s: float
    wall_s: float


def baked(trainer: Trainer, package: Path, shots: Sequence[Shot]) -> Baked:
    """Writes the package of an avatar.

    The first time compiles kernels or loads them from disk; the second is measured.

    Raises:
        ExportRefused: If it is too blurred for one.
    """
    views = [(shot.pose, shot.camera) for shot in shots]
    for _ in range(2):
        cpu, wall = time.process_time(), time.perf_counter()
        taken = snapshot(trainer, package, views, mark=None)
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        if taken.exported is None:
            raise ExportRefused(str(taken.refused))
    return Baked(cpu_s=cpu, wall_s=wall)


def package_marks(name: str, package: Path, bake: Baked) -> Iterator[Mark]:
    """Seconds and bytes."""
    with zipfile.ZipFile(package) as archive:
        sizes = {info.filename: info.compress_size for info in archive.infolist()}
    tables = sum(size for entry, size in sizes.items() if entry.startswith("hq/"))
    tables += sizes["player.onnx"]
    largest = sorted(sizes.items(), key=lambda item: -item[1])[:3]
    yield Mark(
        name=f"{name}: baking, checking and writing, s wall",
        value=bake.wall_s,
        least="≤ 20",
        moonshot="≤ 5",
        beside=f"CPU {bake.cpu_s:.1f} s; torch and numba on one thread",
    )
    yield Mark(
        name=f"{name}: the HQ tier in the package, MB",
        value=tables / MB,
        least="≤ 5.5",
        beside=", ".join(f"{entry} {size / MB:.2f}" for entry, size in largest),
    )
    yield Mark(
        name=f"{name}: the whole file, MB",
        value=package.stat().st_size / MB,
        least="≤ 7.5",
        moonshot="< 3.6",
    )

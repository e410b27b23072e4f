"""Cores, memory and disk of the machine that an attempt runs on."""

import os
import re
import shutil
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from apps.report.hardware import CGROUP, processor_name, usable_cores
from capture.input_error import InputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

PAGE_MB = 4096 / 1e6 if sys.platform == "win32" else os.sysconf("SC_PAGE_SIZE") / 1e6
"""Size of a memory page, MB."""
WORK_PREFIX = "ia-batch-"
"""Start of the names of work folders on a node's disk."""
WORK_PATTERN = re.compile(rf"{WORK_PREFIX}\d+-\d+")
"""Names of work folders: process and time."""
LOCK_NAME = "in-use"
"""File in a work folder: locked as long as its process lives; holds the bytes it has reserved."""
POLL_S = 0.5
"""Interval at which a full disk budget is looked at again, seconds."""


def total_memory_mb() -> float:
    """Return the memory of this machine or container, MB."""
    total = os.sysconf("SC_PHYS_PAGES") * PAGE_MB
    limit = _cgroup_mb("memory.max")
    return total if limit is None else min(total, limit)


def available_memory_mb() -> float:
    """Return the memory that processes can still take without swapping, MB."""
    available = os.sysconf("SC_AVPHYS_PAGES") * PAGE_MB
    with suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        line = next(line for line in lines if line.startswith("MemAvailable:"))
        available = float(line.split()[1]) * 1024 / 1e6
    limit, used = _cgroup_mb("memory.max"), _cgroup_mb("memory.current")
    return available if limit is None or used is None else min(available, limit - used)


def _cgroup_mb(name: str) -> float | None:
    try:
        return int((CGROUP / name).read_text(encoding="ascii")) / 1e6
    except (OSError, ValueError):  # no such system, or "max"
        return None


def tree_memory_mb(process: int) -> float:
    """Return the resident memory of a process and all its descendants, MB; 0 where unknown."""
    pages, waiting = 0, [str(process)]
    while waiting:
        place = Path("/proc", waiting.pop())
        with suppress(OSError, ValueError, IndexError):  # it may just have ended
            pages += int((place / "statm").read_text(encoding="ascii").split()[1])
            for children in (place / "task").glob("*/children"):
                waiting += children.read_text(encoding="ascii").split()
    return pages * PAGE_MB


def describe_machine() -> dict[str, object]:
    """Return host name, processor, cores and memory of this machine."""
    return {
        "host": socket.gethostname(),
        "processor": processor_name(),
        "cores": usable_cores(),
        "memory_mb": round(total_memory_mb()),
    }


@contextmanager
def work_folder(
    place: Path, wanted_bytes: int, budget_bytes: int | None, stopped: Callable[[], bool]
) -> Iterator[Path]:
    """Make a folder on this node's disk for one attempt, and remove it afterwards.

    Folders of processes that were killed are removed as well: their locks are gone.

    Args:
        place: Folder for work folders, used by all attempts on this node.
        wanted_bytes: What will be fetched into the folder.
        budget_bytes: What all attempts on this node may have fetched at a time; None for any.
            Waits until there is room.
        stopped: Whether to give up waiting.

    Raises:
        InputError: If a capture alone exceeds the budget.
    """
    if budget_bytes is not None and wanted_bytes > budget_bytes:
        raise InputError(
            f"The capture has {wanted_bytes / 1e9:.2f} GB, but --disk allows "
            f"{budget_bytes / 1e9:.2f} GB on a node. Increase --disk."
        )
    place.mkdir(parents=True, exist_ok=True)
    folder, descriptor = _reserve(place, wanted_bytes, budget_bytes, stopped)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(descriptor)


def _reserve(
    place: Path, wanted: int, budget: int | None, stopped: Callable[[], bool]
) -> tuple[Path, int]:
    """Wait for room, then make a folder with a locked file; one process at a time decides."""
    while True:
        with _locked(place / LOCK_NAME):
            held = sum(_reserved_or_remove(folder) for folder in place.glob(f"{WORK_PREFIX}*"))
            if budget is None or held + wanted <= budget or stopped():
                folder = place / f"{WORK_PREFIX}{os.getpid()}-{time.monotonic_ns()}"
                folder.mkdir()
                descriptor = os.open(folder / LOCK_NAME, os.O_RDWR | os.O_CREAT, 0o666)
                if fcntl is not None:
                    fcntl.flock(descriptor, fcntl.LOCK_EX)
                os.write(descriptor, str(wanted).encode())
                return folder, descriptor
        time.sleep(POLL_S)


def _reserved_or_remove(folder: Path) -> int:
    """Return the bytes that a work folder has reserved; remove it if its process is gone."""
    if WORK_PATTERN.fullmatch(folder.name) is None or folder.is_symlink():
        return 0  # a user's, who likes the name
    try:
        with (folder / LOCK_NAME).open("rb+") as lock:
            if fcntl is None:
                return int(lock.read() or 0)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                return int(lock.read() or 0)
    except (OSError, ValueError):  # killed before it had a lock: it is empty, or a user's
        with suppress(OSError):
            folder.rmdir()
        return 0
    shutil.rmtree(folder, ignore_errors=True)
    return 0


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    with path.open("a") as file:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX)
        yield

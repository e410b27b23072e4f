"""CPU contention: time for which threads were ready to run while other programs held the cores.

Linux reports how long each thread was ready without running (schedstat), and how long a quota of
its control group throttled it (cpu.stat). Elsewhere contention is estimated as wall time minus CPU
time of training steps: at least one thread has work during a step. Waiting for frames never counts.
"""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import final

from avatar.training.trainer import Trainer

THREADS_FOLDER = Path("/proc/self/task")
"""Holds one folder per thread of this process (Linux)."""
CGROUP_FILE, CGROUP_ROOT = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")
"""The control group of this process, and where groups are mounted (Linux)."""
MIN_CPU_SHARE = 0.5
"""Share of the usable CPU time below which the user is warned."""
MIN_CONTENTION_S = 5.0
"""Contention below which the user is not warned, seconds."""


@final
class CpuContentionMeter:
    """Measures contention from its construction on."""

    def __init__(self, trainer: Trainer, threads_folder: Path = THREADS_FOLDER) -> None:
        """Start to measure.

        Args:
            trainer: Its steps are timed where the system does not report waiting threads.
            threads_folder: Holds one folder per thread.
        """
        self._trainer, self._tasks = trainer, threads_folder
        self._waited = _thread_wait_s(threads_folder)
        self._throttled_s = _throttled_s()
        self._cpu_s, self._steps = trainer.cpu_seconds, trainer.steps
        self._stepping = trainer.step_wall_seconds, trainer.step_cpu_seconds

    def measure(self) -> "CpuTime":
        """Return the CPU time used and the contention since construction."""
        trainer, now = self._trainer, _thread_wait_s(self._tasks)
        steps = trainer.steps - self._steps
        got_s = trainer.cpu_seconds - self._cpu_s
        if now:
            waited_s = sum(each - self._waited.get(task, 0.0) for task, each in now.items())
            waited_s += _throttled_s() - self._throttled_s
        else:
            wall, cpu = self._stepping
            waited_s = (trainer.step_wall_seconds - wall) - (trainer.step_cpu_seconds - cpu)
        return CpuTime(used_s=got_s, waited_s=max(0.0, waited_s), steps=steps)


@dataclass(frozen=True, kw_only=True)
class CpuTime:
    """CPU time of a period of training.

    Attributes:
        used_s: CPU seconds that the process used.
        waited_s: Seconds for which its threads were ready to run without a core, summed.
        steps: Training steps in this period.
    """

    used_s: float
    waited_s: float
    steps: int

    @property
    def granted_share(self) -> float:
        """CPU time used, as a fraction of the CPU time that could have been used, in [0, 1]."""
        wanted_s = self.used_s + self.waited_s
        return self.used_s / wanted_s if wanted_s > 0.0 else 1.0

    def warning(self) -> str | None:
        """Return a warning with advice; None if the process got enough CPU time."""
        if self.granted_share >= MIN_CPU_SHARE or self.waited_s < MIN_CONTENTION_S:
            return None
        usual = self.steps / max(self.granted_share, 1e-3)
        return (
            f"Other programs used the CPU: this run got {self.used_s:.0f} of "
            f"{self.used_s + self.waited_s:.0f} core-seconds and made {self.steps} instead of "
            f"about {usual:.0f} steps. Close them and continue with --resume and more --seconds."
        )


def _thread_wait_s(tasks: Path) -> dict[str, float]:
    """Return for each thread how long it was ready without running, seconds; empty if unknown."""
    waited = {}
    for task in tasks.glob("*"):
        with suppress(OSError, ValueError, IndexError):  # a thread may just have ended
            waited[task.name] = int((task / "schedstat").read_text().split()[1]) / 1e9
    return waited


def _throttled_s() -> float:
    """Return how long a quota throttled this process's control group, seconds; 0 if unknown."""
    with suppress(OSError, ValueError, IndexError):
        group = CGROUP_FILE.read_text().rsplit("::", 1)[1].strip().lstrip("/")
        for line in (CGROUP_ROOT / group / "cpu.stat").read_text().splitlines():
            name, value = line.split()
            if name == "throttled_usec":
                return int(value) / 1e6
    return 0.0

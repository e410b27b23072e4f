"""CPU time that a process waited for because other programs held the processor.

Waiting for frames does not count: only threads that were ready to run are counted. Linux says for
every thread how long it was ready and did not run (schedstat), and how long a quota of its control
group held it back (cpu.stat). Elsewhere it is what steps of training lack to one busy core: while
a step lasts, at least one thread has work.
"""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import final

from avatar.training.trainer import Trainer

THREADS_FOLDER = Path("/proc/self/task")
CGROUP_FILE, CGROUP_ROOT = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")
MIN_CPU_SHARE = 0.5
"""A run that gets less than this share of the CPU time that it could use is warned of."""
MIN_CONTENTION_S = 5.0
"""Less waiting than this is not worth a word."""


@final
class CpuContentionMeter:
    """Measures from its making on."""

    def __init__(self, trainer: Trainer, threads_folder: Path = THREADS_FOLDER) -> None:
        """Begins now.

        Args:
            trainer: Whose steps are looked at where the system does not say how long threads wait.
            tasks: A folder for each thread.
        """
        self._trainer, self._tasks = trainer, threads_folder
        self._waited = _thread_wait_s(threads_folder)
        self._throttled_s = _throttled_s()
        self._cpu_s, self._steps = trainer.cpu_seconds, trainer.steps
        self._stepping = trainer.step_wall_seconds, trainer.step_cpu_seconds

    def measure(self) -> "CpuTime":
        """What was got and what was waited for so far."""
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
    """CPU time of a stretch of training.

    Attributes:
        got_s: CPU seconds that the process used.
        waited_s: Seconds for which its threads were ready to run and had no core, summed.
        steps: Training steps made meanwhile.
    """

    used_s: float
    waited_s: float
    steps: int

    @property
    def granted_share(self) -> float:
        """What was got of what could have been used, in [0, 1]."""
        wanted_s = self.used_s + self.waited_s
        return self.used_s / wanted_s if wanted_s > 0.0 else 1.0

    def warning(self) -> str | None:
        """What it means and what to do; None if the machine gave enough."""
        if self.granted_share >= MIN_CPU_SHARE or self.waited_s < MIN_CONTENTION_S:
            return None
        usual = self.steps / max(self.granted_share, 1e-3)
        return (
            f"This machine gave the run {self.used_s:.0f} of the {self.used_s + self.waited_s:.0f} "
            "core-seconds that it could have used, because other programs are running: it made "
            f"{self.steps} steps instead of about {usual:.0f}, so the avatar is less sharp than it "
            "can be. Close other programs and learn on (the same command with --resume and more "
            "--seconds)."
        )


def _thread_wait_s(tasks: Path) -> dict[str, float]:
    """For each thread, how long it was ready to run and did not, seconds; empty if unknown."""
    waited = {}
    for task in tasks.glob("*"):
        with suppress(OSError, ValueError, IndexError):  # a thread may just have ended
            waited[task.name] = int((task / "schedstat").read_text().split()[1]) / 1e9
    return waited


def _throttled_s() -> float:
    """How long a quota has held this process's control group back, seconds; 0 if unknown."""
    with suppress(OSError, ValueError, IndexError):
        group = CGROUP_FILE.read_text().rsplit("::", 1)[1].strip().lstrip("/")
        for line in (CGROUP_ROOT / group / "cpu.stat").read_text().splitlines():
            name, value = line.split()
            if name == "throttled_usec":
                return int(value) / 1e6
    return 0.0

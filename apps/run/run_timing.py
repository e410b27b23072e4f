"""Time of a run: what is left, what other programs took, and how the frame stream flows.

Estimated durations are core-seconds of an idle core, rounded up: packaging as measured for the
README, scoring as measured for docs/evaluation.md, pose fitting and report as rough estimates.

CPU contention is time for which threads were ready to run while other programs held the cores.
Linux reports how long each thread was ready without running (schedstat), and how long a quota of
its control group throttled it (cpu.stat). Elsewhere it is estimated as wall time minus CPU time of
training steps: at least one thread has work during a step. Waiting for frames never counts.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar, final

from apps.report.report_schema import Percentiles, StreamStats
from avatar.training.frame_stream import RedundantFrame
from avatar.training.trainer import Trainer
from capture.process_metrics import ReservoirSample
from capture.source import Frame, FrameSource
from preprocess.observation import DroppedFrame, Observation

PACKAGING_S = 12.0
"""Baking, fine-tuning, checking and writing a package, seconds."""
SCORE_S = 0.3
"""Rendering and scoring one held-out frame of `SCORED_PX`, seconds."""
SCORED_PX = 540
"""Longer side of the frame that `SCORE_S` was measured with, pixels."""
POSE_FIT_S = 0.6
"""Fitting the pose of one held-out frame, without the two scorings, seconds."""
REPORT_S = 3.0
"""Drawing and writing the report, seconds."""


def post_training_seconds(
    held_out: int,
    longer_side_px: int,
    *,
    fit_poses: bool,
    slowdown: float = 1.0,
    scoring_limit_s: float = math.inf,
) -> float:
    """Estimate the seconds from the last step to the report.

    Args:
        held_out: Number of frames to score.
        longer_side_px: Their longer side.
        fit_poses: Whether poses are fitted to them as well.
        slowdown: Factor by which the machine is slower than an idle one.
        scoring_limit_s: Seconds after which no more frames are scored.
    """
    scoring = SCORE_S * (longer_side_px / SCORED_PX) ** 2
    each = scoring + (POSE_FIT_S + scoring if fit_poses else 0.0)
    return slowdown * (PACKAGING_S + REPORT_S) + min(slowdown * held_out * each, scoring_limit_s)


def expected_held_out(frames: int | None, hold_every: int, maximum: int) -> int:
    """Estimate the number of held-out frames; `maximum` if the video's length is unknown."""
    if hold_every == 0:
        return 0
    return maximum if frames is None else min(maximum, max(1, frames // hold_every))


def describe_position(
    *,
    elapsed_s: float,
    budget_s: float,
    step: int,
    steps: int | None,
    frames_read: tuple[int, int | None] | None,
) -> str:
    """Describe the progress of training, and what remains once its time is up.

    Args:
        elapsed_s: Training time up to now.
        budget_s: Training time requested.
        step: Training steps made.
        steps: Training steps requested instead of a time; None otherwise.
        frames_read: Frames read up to now and in total (None: unknown); None once all are read.
    """
    if steps:
        return f"step {step} of {steps}, {elapsed_s:.0f} s"
    if elapsed_s <= budget_s:
        return f"{elapsed_s:.0f} of {budget_s:g} s, step {step}"
    elapsed = f"{elapsed_s:.0f} s (limit {budget_s:g} s)"
    if frames_read is None:
        return f"{elapsed}: last steps"
    read, total = frames_read
    frames = f"{read} frames" if total is None else f"{read} of {total} frames"
    return f"{elapsed}: finishing the first pass over the video, {frames} read"


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


Item = TypeVar("Item")

MAX_DROPPED_LISTED = 1000
"""Dropped frames that are listed with their reasons; the rest are only counted."""
LATENESS_WARNING_S = 0.5
"""Lateness of playback, 95th percentile in seconds, from which the user is warned."""


@final
class StreamMeter:
    """Counts frames on the producer's thread; read on the consumer's.

    Attributes:
        frames_read: Frames that the source delivered.
        dropped: The first `MAX_DROPPED_LISTED` dropped frames.
        dropped_count: Number of dropped frames.
        near_duplicates: Frames not trained on because they resemble the previous one.
        held_out_count: Held-out frames that have reached the trainer.
        first_frame_at: When the first frame was available, on `time.perf_counter`'s clock.
        last_frame_s: Time of the newest frame since the first one, in the video.
        size_px: Width and height of training images.
        preparation_s: From decoding to ready for training, without waiting for the source.
        lateness_s: From the moment a frame was due until its preparation began.
        latency_s: From the moment a frame was available until the trainer had it.
        current_latency_s: Latency of the newest frame.
        inbox_depth: Frames waiting in the inbox, sampled after each step.
        inbox_dropped: Frames that the inbox replaced by newer ones.
    """

    def __init__(self, stop: threading.Event, source: FrameSource) -> None:
        """Measure one source; `measure_preparation` ends early once `stop` is set."""
        self._stop, self._source = stop, source
        self.frames_read = self.dropped_count = self.near_duplicates = self.held_out_count = 0
        self.dropped: list[DroppedFrame] = []
        self.first_frame_at: float | None = None
        self.last_frame_s = 0.0
        self.size_px: tuple[int, int] | None = None
        self.preparation_s, self.lateness_s = ReservoirSample(), ReservoirSample()
        self.latency_s, self.inbox_depth = ReservoirSample(), ReservoirSample()
        self.current_latency_s = 0.0
        self.inbox_dropped = 0
        self._first_time_s = self._clip_started_at = 0.0
        self._available_at: deque[tuple[int, float]] = deque()

    def measure_arrival(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Pass frames on and record when each was available."""
        for frame in frames:
            now = time.perf_counter()
            there_at = now if frame.due_s is None else frame.due_s
            self.lateness_s.add(now - there_at)
            if self.first_frame_at is None:
                self.first_frame_at, self._first_time_s = there_at, frame.time_s
                self._clip_started_at = there_at
            self.last_frame_s = max(self.last_frame_s, frame.time_s - self._first_time_s)
            if frame.due_s is not None:  # a resumed run plays on from its last frame
                self._clip_started_at = there_at - (frame.time_s - self._first_time_s)
            self.frames_read += 1
            self._available_at.append((frame.index, there_at))
            yield frame

    def count_observations(
        self, observations: Iterable[Observation | DroppedFrame]
    ) -> Iterator[Observation | DroppedFrame]:
        """Pass observations on; count dropped frames and record the image size."""
        for item in observations:
            if isinstance(item, DroppedFrame):
                self.dropped_count += 1
                if len(self.dropped) < MAX_DROPPED_LISTED:
                    self.dropped.append(item)
            else:
                self.size_px = item.camera.size_px
            yield item

    def measure_preparation(self, items: Iterator[Item]) -> Iterator[Item]:
        """Pass items on until `stop` is set; record how long each took to prepare."""
        while not self._stop.is_set():
            started, waited = time.perf_counter(), self._source.waited_s
            try:
                item = next(items)
            except StopIteration:
                return
            waited = self._source.waited_s - waited
            if isinstance(item, RedundantFrame):
                self.near_duplicates += 1
            else:
                self.preparation_s.add(time.perf_counter() - started - waited)
            yield item

    def mark_arrived(self, index: int, *, held_out: bool) -> None:
        """Record that the trainer has a frame; forget older ones that it never got."""
        self.held_out_count += held_out
        while self._available_at and self._available_at[0][0] <= index:
            number, there_at = self._available_at.popleft()
            if number == index:
                self.current_latency_s = time.perf_counter() - there_at
                self.latency_s.add(self.current_latency_s)

    def lateness_warnings(self) -> Iterator[str]:
        """Yield warnings about frames that could not be prepared as fast as they came."""
        dropped, late = self._source.dropped + self.inbox_dropped, self.lateness_s
        if dropped:
            yield (
                f"{dropped} frames were dropped because tracking or preprocessing is slower than "
                "the frame rate. The others are enough if the person moves slowly; else reduce "
                "--size."
            )
        playback = self._source.paced and not self._source.live
        if playback and not dropped and late.percentile(95.0) > LATENESS_WARNING_S:
            yield (
                f"Playback lagged by up to {late.largest:.1f} s (median "
                f"{late.percentile(50.0):.1f} s): preprocessing is slower than the frame rate. No "
                "frame was dropped. Reduce --size, or use every other frame (--frames ::2)."
            )

    def stats(self, *, ready_at: float | None) -> StreamStats:
        """Summarize the stream for the report.

        Args:
            ready_at: When the package was written, on `time.perf_counter`'s clock.
        """
        ready = None
        if ready_at is not None and self.first_frame_at is not None:
            ready = ready_at - (self._clip_started_at + self.last_frame_s)
        return StreamStats(
            realtime=self._source.paced,
            ingest_ms=Percentiles.of(self.preparation_s, scale=1000.0),
            inbox_dropped=self.inbox_dropped + self._source.dropped,
            ready_after_last_frame_seconds=ready,
            latency_ms=Percentiles.of(self.latency_s, scale=1000.0),
            lateness_ms=Percentiles.of(self.lateness_s, scale=1000.0),
            inbox_depth=Percentiles.of(self.inbox_depth),
        )

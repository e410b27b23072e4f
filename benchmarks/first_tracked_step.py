"""A process that plays a video without poses, and prints how soon it learns from it.

    python -m benchmarks.first_tracked_step VIDEO OUT [OPTION ...]

It does what `ia-ingest VIDEO --realtime` does, up to the first step: code, kernels and networks
are loaded before the video starts. Prints the seconds from the moment at which the first frame was
due to the end of the first training step, and the CPU time from opening the video until then.
OPTIONs are ia-ingest's.
"""

import sys
import threading
import time
from typing import final

from avatar.events import Stepped, TrainEvent
from instant_avatar.cli.command_line import parse_arguments
from instant_avatar.cli.console import Console
from instant_avatar.run.ingest_arguments import IngestArguments
from instant_avatar.run.session_start import prepare_trainer, set_threads
from instant_avatar.run.training_session import TrainingSession
from preprocess.observation import Observation


@final
class FirstStep:
    """Stops a training session after its first step.

    Attributes:
        at: When that step had been made, on `time.perf_counter`'s clock; NaN before.
        cpu_s: CPU time of the process until then.
    """

    def __init__(self, stop: threading.Event) -> None:
        """No step has been made."""
        self._stop, self.at, self.cpu_s = stop, float("nan"), float("nan")

    def on_frame(self, observation: Observation, *, held_out: bool) -> None:
        """Not needed."""

    def on_event(self, event: TrainEvent) -> None:
        """Note the time of the first step."""
        if isinstance(event, Stepped) and not self._stop.is_set():
            self.at, self.cpu_s = time.perf_counter(), time.process_time()
            self._stop.set()

    def between_steps(self, session: TrainingSession) -> None:
        """Not needed."""


def time_first_step(arguments: IngestArguments) -> tuple[float, float]:
    """Seconds from the first frame of a stream to the first step, and CPU time for it."""
    run, console, stop = arguments.run_folder(), Console(), threading.Event()
    set_threads(arguments.threads)
    began_cpu_s = time.process_time()
    capture = arguments.open_capture()
    start = prepare_trainer(arguments, capture, run, console)
    run.start_run(resume=False)
    first = FirstStep(stop)
    session = TrainingSession(
        start.trainer, capture, run, console, stop, start.notes, observers=(first,)
    )
    session.train()
    wall_s = first.at - (session.meter.first_frame_at or float("nan"))
    return wall_s, first.cpu_s - began_cpu_s


def main() -> None:
    """Print both."""
    video, out, *options = sys.argv[1:]
    words = [video, "--realtime", "--out", out, *options]
    print(*time_first_step(parse_arguments(IngestArguments, "ia-ingest", words)))


if __name__ == "__main__":
    main()

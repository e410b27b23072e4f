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
from contextlib import closing

from avatar.events import Stepped
from instant_avatar.cli.command_line import parse_arguments
from instant_avatar.cli.console import Console
from instant_avatar.run.ingest_arguments import IngestArguments
from instant_avatar.run.run_capture import open_observations
from instant_avatar.run.session_start import prepare_trainer, set_threads
from instant_avatar.run.training_session import TrainingSession


def time_first_step(arguments: IngestArguments) -> tuple[float, float]:
    """Seconds from the first frame of a stream to the first step, and CPU time for it."""
    run, console = arguments.run_folder(), Console()
    set_threads(arguments.threads)
    began_cpu_s = time.process_time()
    observations, _ = open_observations(arguments, arguments.capture_inputs(), run, console)
    start = prepare_trainer(arguments, observations.capture, run, console)
    run.start_run(resume=False)
    session = TrainingSession(start.trainer, observations, run, threading.Event(), start.notes)
    with closing(session.run()) as events:
        next(event for event in events if isinstance(event, Stepped))
        wall_s = time.perf_counter() - (session.meter.first_frame_at or float("nan"))
        return wall_s, time.process_time() - began_cpu_s


def main() -> None:
    """Print both."""
    video, out, *options = sys.argv[1:]
    words = [video, "--realtime", "--out", out, *options]
    print(*time_first_step(parse_arguments(IngestArguments, "ia-ingest", words)))


if __name__ == "__main__":
    main()

"""ia-ingest: train an avatar from a video of one person while the video is being read."""

import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

from capture.hardware import usable_cores
from instant_avatar.cli.command_line import (
    INTERRUPTED,
    exit_on_interrupt,
    fill_optional_value,
    require_packages,
    run_main,
    without_garbage_collection,
)
from instant_avatar.cli.console import Console
from instant_avatar.cli.shared_options import open_recording
from instant_avatar.run.ingest_arguments import PROGRAM, VIEW_PORT, IngestArguments
from instant_avatar.run.run_folder import RunFolder
from instant_avatar.run.start_up import (
    FitProcess,
    fitting_beside,
    preparing_to_train,
)
from preprocess.capture_inputs import CaptureInputs, InputKind

if TYPE_CHECKING:  # it imports torch
    from capture.source import Frame
    from instant_avatar.run.session_events import EventReader
    from preprocess.capture_session import Capture, CaptureFit
    from preprocess.tracking.keypoints import PersonKeypoints


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    words = fill_optional_value(sys.argv[1:] if argv is None else argv, "--view", VIEW_PORT)
    return run_main(PROGRAM, IngestArguments, ingest, words)


def ingest(
    arguments: IngestArguments, console: Console, readers: Sequence["EventReader"] = ()
) -> int:
    """Open, track, solve cameras, align; then train, bake and report, which `readers` read of.

    After an `InputError` nothing was written but what was tracked, if that is refused; on a full
    disk the newest checkpoint is kept.
    """
    started_at = time.perf_counter()
    solver = ("pycolmap",) if arguments.cameras == "solve" else ()
    require_packages("torch", "numba", "onnx", *solver)
    arguments.validate()
    inputs = arguments.capture_inputs()
    inputs.check_named()
    if not inputs.is_live:
        open_recording(inputs, console)
    run, read = arguments.run_folder(), inputs.input_paths()
    run.check_usable(read, resume=arguments.resume, overwrite=arguments.overwrite)
    with (
        run.claim(console, resume=arguments.resume, overwrite=arguments.overwrite),
        ExitStack() as cleanup,
    ):
        fitting = _fit_beside(arguments, inputs, cleanup)
        wait = cleanup.enter_context(preparing_to_train(console))
        trainer_code = _TrainerCode(arguments, inputs, run, console, wait, fitting)
        with without_garbage_collection():
            from instant_avatar.run.run_capture import open_observations, write_solved_cameras

        command = arguments.as_json()
        if inputs.kind is InputKind.STREAMED:  # its frames come as soon as it is open
            trainer_code.load()
        observations, before_fit = open_observations(
            arguments, inputs, run, console,
            lambda frame, person: _show_tracked(frame, person, readers),
            background=cleanup.enter_context(ThreadPoolExecutor(1)),
            **({} if fitting is None else {"fit": trainer_code.load_and_fit}),
        )  # fmt: skip
        threads = trainer_code.load()
        from instant_avatar.report.report_writer import ReportWriter
        from instant_avatar.run.session_start import run_session

        report = ReportWriter(
            observations.capture, run, console,
            command=command, started_at=started_at, threads=threads,
            copy=None if arguments.json is None else (arguments.json, arguments.may_replace_json),
        )  # fmt: skip
        is_interrupted = run_session(
            arguments, observations, run, console, [*readers, report],  # its page takes seconds
            on_start=lambda: write_solved_cameras(before_fit, run, console),
            rig=None if fitting is None else fitting.rig(),
        )  # fmt: skip
        code = report.exit_code()
        return INTERRUPTED if is_interrupted else code


def _fit_beside(
    arguments: IngestArguments, inputs: CaptureInputs, cleanup: ExitStack
) -> FitProcess | None:
    """Start a process that fits a recording, if there is a second core and nothing is kept."""
    cores = min(arguments.threads or usable_cores(), usable_cores())
    if cores < 2 or arguments.resume or inputs.kind is InputKind.STREAMED:
        return None
    is_posed = inputs.kind is InputKind.POSED
    if is_posed and (inputs.cameras == "solve" or not arguments.refine_poses):
        return None
    return cleanup.enter_context(fitting_beside())


@final
@dataclass
class _TrainerCode:
    """Torch and the kernels, loaded once: beside the fit, where another process fits.

    Attributes:
        wait: Waits for the kernels of a first run.
        threads: Number of numba's threads, once torch is loaded.
    """

    arguments: IngestArguments
    inputs: CaptureInputs
    run: RunFolder
    console: Console
    wait: Callable[[], None]
    fitting: FitProcess | None
    threads: int = 0

    def load(self) -> int:
        """Import torch, and set and return the number of threads."""
        if not self.threads:
            with exit_on_interrupt(self.console, PROGRAM, self.run.release):
                self._import()
        return self.threads

    def load_and_fit(self, capture: "Capture", console: Console) -> "CaptureFit | None":
        """Load torch and the kernels while another process fits a capture."""
        assert self.fitting is not None
        is_posed = self.inputs.kind is InputKind.POSED
        self.fitting.send(capture, self.inputs.height_m, with_rig=is_posed)
        release = self.run.release
        with exit_on_interrupt(console, PROGRAM, release) if is_posed else nullcontext():
            self._import()  # after Ctrl-C, what was tracked is kept
            from instant_avatar.run.session_start import warm_up_for

            warm_up_for(capture, console)
        with console.status("fitting body and poses"):
            return self.fitting.fit(capture)

    def _import(self) -> None:
        self.wait()
        with self.console.status("loading torch"), without_garbage_collection():
            from instant_avatar.report import report_writer  # noqa: F401
            from instant_avatar.run.session_start import set_threads

            self.threads = set_threads(self.arguments.threads)


def _show_tracked(
    frame: "Frame", person: "PersonKeypoints | None", readers: Sequence["EventReader"]
) -> None:
    from instant_avatar.run.session_events import Tracked

    for reader in readers:
        reader(Tracked(frame=frame, person=person))


if __name__ == "__main__":
    sys.exit(main())

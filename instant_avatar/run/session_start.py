"""Start of a training session: threads, kernels, a new, resumed or extended trainer, the viewer."""

import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
import torch

from avatar.config import HELD_OUT_STRIDE, TrainConfig
from avatar.evaluation.all_round_verdict import FILMED
from avatar.evaluation.coverage import coverage_advice, expected_coverage
from avatar.rig import Rig
from avatar.training import checkpoint, train
from avatar.training.trainer import Trainer
from capture.hardware import usable_cores
from capture.input_error import InputError, counted
from capture.live_sources import DONE_FILE_NAME
from capture.source import FrameSource
from export.bake import proxy_surface
from instant_avatar.cli.command_line import exit_on_interrupt, stop_on_interrupt
from instant_avatar.cli.console import Console
from instant_avatar.run.console_reader import ConsoleReader
from instant_avatar.run.final_scoring import EarlierVideos
from instant_avatar.run.ingest_arguments import PROGRAM, IngestArguments
from instant_avatar.run.run_folder import RunFolder
from instant_avatar.run.run_tracking import remove_tracking
from instant_avatar.run.session_events import EventReader, SessionEvent
from instant_avatar.run.training_session import TrainingSession
from preprocess.capture_session import Capture, ObservationSource
from preprocess.licence_chain import made_with


def set_threads(requested: int | None) -> int:
    """Set the threads of numba: as requested, else one per usable core; torch gets one.

    Return their number; numba cannot exceed the number it started with. torch is left with
    operations on small arrays, for which a second pool of threads only has to be woken.
    """
    threads = max(1, min(requested or usable_cores(), numba.get_num_threads()))
    torch.set_num_threads(1)
    numba.set_num_threads(threads)
    return threads


if TYPE_CHECKING:  # viser is an optional extra
    from instant_avatar.run.live_viewer import LiveViewer


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedTrainer:
    """A trainer that is ready for the frames of a capture.

    Attributes:
        restore_count: Frames of this video that the trainer was trained on before.
        notes: Stored with each checkpoint.
    """

    trainer: Trainer
    restore_count: int
    notes: dict[str, Any]


def prepare_trainer(
    arguments: IngestArguments,
    capture: Capture,
    run: RunFolder,
    console: Console,
    rig: Rig | None = None,
) -> PreparedTrainer:
    """Build a new trainer, or load the run's checkpoint to resume it or to add a video.

    `rig` is that of the capture's person, if it is there.
    """
    if arguments.resume and run.has_checkpoint():
        prepared = _load_trainer(arguments, capture, run, console)
    else:
        if arguments.resume:
            console.info(f"No checkpoint in {run.path}; starting a new run.")
        prepared = _new_run(arguments, capture, rig)
    _warm_up(prepared.trainer, console)
    _announce_coverage(capture, console)
    _announce_duration(arguments, prepared.trainer, capture.source, console)
    return prepared


def warm_up_for(capture: Capture, console: Console) -> None:
    """Load the kernels on one core, while another process fits the capture's person."""
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    rig = Rig.from_shaped_body(capture.shaped, coarseness=3.0)
    _warm_up(Trainer(rig, TrainConfig()), console)
    numba.set_num_threads(threads)


def _warm_up(trainer: Trainer, console: Console) -> None:
    """Compile the kernels, or load them; a second time on one thread nothing is done or shown."""
    if threading.get_ident() in train.WARM_THREADS:
        return
    with console.status("compiling kernels (slow on the first run only)"):
        train.warm_up(trainer)
        proxy_surface.warm_up()


def run_session(
    arguments: IngestArguments,
    observations: ObservationSource,
    run: RunFolder,
    console: Console,
    readers: Sequence[EventReader],
    *,
    on_start: Callable[[], object] = lambda: None,
    rig: Rig | None = None,
) -> bool:
    """Prepare trainer and viewer, and run a session to its end; console and `readers` read it.

    `rig` is that of the capture's person, if it is there. `on_start` is called once an older run
    has been removed. Ctrl-C asks the session to stop. A viewer stays open until Ctrl-C. Returns
    whether Ctrl-C was pressed, even as the page was drawn.
    """
    capture = observations.capture
    with exit_on_interrupt(console, PROGRAM, run.release):
        start = prepare_trainer(arguments, capture, run, console, rig)
        viewer = _open_viewer(arguments, capture, run, console)
    run.start_run(resume=arguments.resume)
    if capture.figures("tracking") is None and not arguments.resume:
        remove_tracking(run)
    on_start()
    try:
        with stop_on_interrupt(console) as stop, ExitStack() as cleanup:
            session = TrainingSession(
                start.trainer, observations, run, stop, start.notes,
                restore_count=start.restore_count,
            )  # fmt: skip
            watching = () if viewer is None else (viewer.watch(session),)
            shown = ConsoleReader(session, console, cleanup)
            _show_events(session, [shown, *watching, *readers])
        is_interrupted = stop.is_set()
        if viewer is not None and not is_interrupted:
            console.info(f"The viewer stays open at {viewer.page.address}. Ctrl-C closes it.")
            viewer.serve_until_interrupt(session)
        return is_interrupted
    except (OSError, KeyboardInterrupt) as error:
        error.add_note(run.describe_remaining_files())
        raise
    finally:
        if viewer is not None:
            viewer.close()


def _show_events(session: TrainingSession, readers: Sequence[EventReader]) -> None:
    """Run a session to its end, and let each of the readers see every event."""

    def show(event: SessionEvent) -> None:
        for reader in readers:
            reader(event)

    with closing(session.run(show)) as events:
        for event in events:
            show(event)


def _open_viewer(
    arguments: IngestArguments, capture: Capture, run: RunFolder, console: Console
) -> "LiveViewer | None":
    if arguments.view is None:
        return None
    from instant_avatar.run.live_viewer import LiveViewer

    return LiveViewer(capture, run, console, arguments.view)


def new_trainer(
    capture: Capture,
    *,
    seconds: float,
    steps: int | None = None,
    seed: int,
    refine_poses: bool,
    hold_every: int = HELD_OUT_STRIDE,
    rig: Rig | None = None,
) -> Trainer:
    """Build an untrained trainer for the person, the training budget and the image size."""
    config = TrainConfig.for_budget(
        seconds,
        steps=steps,
        footprint_m=capture.pixel_footprint_m(),
        filmed_footprint_m=capture.pixel_footprint_m(as_filmed=True),
        pose_uncertainty=capture.pose_uncertainty,
        held_out_stride=hold_every,
        seed=seed,
    )
    config = replace(config, refine_poses=refine_poses)
    return Trainer(rig or Rig.from_shaped_body(capture.shaped), config)


def _new_run(arguments: IngestArguments, capture: Capture, rig: Rig | None) -> PreparedTrainer:
    trainer = new_trainer(
        capture,
        seconds=arguments.training_seconds(capture.source),
        steps=arguments.steps,
        seed=arguments.seed,
        refine_poses=arguments.refine_poses,
        hold_every=arguments.hold_out,
        rig=rig,
    )
    notes = {
        "video": capture.identity,
        "name": capture.paths.video.name,
        "made_with": made_with(capture),
    }
    return PreparedTrainer(trainer=trainer, restore_count=0, notes=notes)


def _load_trainer(
    arguments: IngestArguments, capture: Capture, run: RunFolder, console: Console
) -> PreparedTrainer:
    trainer, notes = checkpoint.load(run.checkpoint)
    _check_same_body(trainer, capture, run)
    earlier = EarlierVideos(run, notes)
    if notes.get("video") == capture.identity:
        return _resume_video(arguments, capture, trainer, earlier, notes, console)
    return _add_video(arguments, capture, trainer, earlier, notes, console)


def _resume_video(
    arguments: IngestArguments,
    capture: Capture,
    trainer: Trainer,
    earlier: EarlierVideos,
    notes: dict[str, Any],
    console: Console,
) -> PreparedTrainer:
    before = notes.get("before", {"frames": 0, "seconds": 0.0, "steps": 0})
    unit, budget, spent = _budget(arguments, capture, trainer)
    restore_count = trainer.frames_seen - before["frames"]
    spent -= before[unit]
    console.info(f"Resuming after {spent:.0f} {unit} of training.")
    if spent >= budget:
        console.warning(
            f"This run has used {spent:.0f} of {budget:.0f} {unit}; only package and report will "
            f"be rewritten. Increase --{unit} to continue training."
        )
    earlier.restore_key_frames(trainer, console)
    _extend_budget(trainer, arguments, capture, float(before[unit]))
    return PreparedTrainer(trainer=trainer, restore_count=restore_count, notes=notes)


def _add_video(
    arguments: IngestArguments,
    capture: Capture,
    trainer: Trainer,
    earlier: EarlierVideos,
    notes: dict[str, Any],
    console: Console,
) -> PreparedTrainer:
    unit, _, spent = _budget(arguments, capture, trainer)
    console.info(f"Adding another video to an avatar with {spent:.0f} {unit} of training.")
    earlier.start_new_video(trainer, console)
    notes["name"], notes["video"] = capture.paths.video.name, capture.identity
    known = notes.get("made_with", [])
    if known:  # else it is of a run before these were recorded, and remains unknown
        known += [part for part in made_with(capture) if part not in known]
    _extend_budget(trainer, arguments, capture, spent)
    return PreparedTrainer(trainer=trainer, restore_count=0, notes=notes)


def _budget(
    arguments: IngestArguments, capture: Capture, trainer: Trainer
) -> tuple[str, float, float]:
    """Return the unit of the training budget, the budget, and what the trainer has used of it."""
    if arguments.steps is None:
        return "seconds", arguments.training_seconds(capture.source), trainer.wall_seconds
    return "steps", float(arguments.steps), float(trainer.steps)


def _extend_budget(
    trainer: Trainer, arguments: IngestArguments, capture: Capture, earlier: float
) -> None:
    """Add the budget of this command to what earlier videos have used."""
    trainer.config = replace(
        trainer.config,
        seconds=arguments.training_seconds(capture.source) + earlier,
        steps=None if arguments.steps is None else arguments.steps + int(earlier),
        refine_poses=arguments.refine_poses,
    )


def _check_same_body(trainer: Trainer, capture: Capture, run: RunFolder) -> None:
    """Refuse poses of another body than the checkpoint's."""
    difference_m = abs(trainer.avatar.rig.rest_joints - capture.shaped.joints).max()
    if difference_m > 1e-3:
        raise InputError(
            f"The poses use a different body than the avatar in {run.path} (rest joints differ by "
            f"up to {100.0 * difference_m:.1f} cm), and {run.body_file.name} is missing. Retrain "
            "with --overwrite."
        )


def _announce_coverage(capture: Capture, console: Console) -> None:
    """Print what a recording will not show of the person; nothing of one seen from all sides."""
    frames, selection = capture.geometry().row_frames, capture.source.selection
    rows = np.flatnonzero(capture.motion.valid & np.isfinite(frames)).tolist()
    wanted = [row for row in rows if selection.contains(round(frames[row]))]
    streamed = capture.source.paced or capture.source.frame_count is None
    if streamed or not wanted:  # of a stream only the first poses are known
        return
    some = wanted[:: -(-len(wanted) // 60)]
    views = ((capture.motion[row], capture.camera_of_pose(row)) for row in some)
    expected = expected_coverage(capture.shaped, views)
    if expected.mean_cosine < FILMED.sharp:
        console.warning(
            f"The film shows {expected.seen_share:.0%} of the person's skin; the rest will be "
            f"completed by what it shows, as a guess. {coverage_advice(expected)}"
        )


def _announce_duration(
    arguments: IngestArguments, trainer: Trainer, source: FrameSource, console: Console
) -> None:
    """Print how long training will take, and roughly what comes after it."""
    config = trainer.config
    if arguments.live and arguments.seconds is None and arguments.steps is None:
        if arguments.video.is_file():
            console.info("Training while the film comes, until its end.")
            return
        console.info(
            f"Training while images come: until a file {DONE_FILE_NAME} lies in {arguments.video}, "
            f"no image has come for {arguments.idle_seconds:g} s, or Ctrl-C."
        )
        return
    seconds = config.seconds - trainer.wall_seconds
    if (config.steps - trainer.steps if config.steps else seconds) <= 0:
        return  # a run that is resumed without a larger budget, as a warning says
    duration = f"{seconds:.0f} s" if seconds >= 10.0 else f"{seconds:.1g} s"
    if config.steps:
        duration = counted(config.steps - trainer.steps, "step")
        if not source.paced and config.steps - trainer.steps < (source.frame_count or 0):
            duration += " at least (each frame that is learnt from takes one)"
    console.info(
        f"Training for {duration}; the avatar can be played some seconds later, and half a minute "
        "of finer detail and scores follows, on an otherwise idle machine."
    )

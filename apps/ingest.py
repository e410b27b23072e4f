"""ia-ingest: a recorded video of one person walks in, an avatar walks out."""

import sys
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from apps.checks.preflight_check import correction_hint, preflight_check
from apps.cli.command_line import fill_optional_port, parse_arguments
from apps.cli.console import Console
from apps.cli.exit_codes import BAD_INPUT, DONE, INTERRUPTED, NO_AVATAR, CommandExit, run_command
from apps.cli.interrupt import exit_on_interrupt, stop_on_interrupt
from apps.run.camera_solving import CameraSolving, start_camera_solving
from apps.run.ingest_arguments import VIEW_PORT, IngestArguments
from apps.run.run_folder import RunFolder
from capture.atomic_files import write_text_atomically
from capture.input_error import InputError
from capture.live.camera_device import camera_address
from preprocess.capture_session import Capture

PROGRAM = "ia-ingest"
JOINT_TOLERANCE_M = 1e-3

if TYPE_CHECKING:  # torch is loaded after --help has been answered
    from apps.run.package_snapshot import PackageSnapshot
    from apps.run.report_writer import RunOutcome
    from apps.run.training_result import TrainingResult
    from apps.run.training_session import TrainingSession
    from apps.view.live_viewer import LiveViewer
    from avatar.training.trainer import Trainer


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    words = fill_optional_port(sys.argv[1:] if argv is None else argv, "--view", VIEW_PORT)
    given = parse_arguments(IngestArguments, PROGRAM, words)
    return run_command(PROGRAM, lambda: ingest(given, Console()))


def ingest(arguments: IngestArguments, console: Console) -> int:
    """Does what the arguments say.

    Raises:
        InputError: If the input cannot be used; nothing was written then.
        OSError: If the disk is full; the newest checkpoint is kept.
        Stop: If there is no avatar to show.
    """
    started = time.perf_counter()
    arguments.validate()
    run = arguments.run_folder()
    run.check_usable(
        arguments.capture_inputs().input_paths(),
        resume=arguments.resume,
        overwrite=arguments.overwrite,
    )
    with run.claim(console, resume=arguments.resume, overwrite=arguments.overwrite):
        with console.status("opening video and poses"):
            recording = _open_capture(arguments)
        console.info(_describe_capture(recording))
        for note in recording.notes:
            console.warning(note)
        if not (arguments.resume and run.has_checkpoint()):
            preflight_check(recording, arguments.capture_inputs(), console, force=arguments.force)
        with start_camera_solving(arguments.solve_job(recording), recording, run) as attempt:
            return _train_and_report(arguments, recording, run, console, attempt, started)


def _train_and_report(
    arguments: IngestArguments,
    recording: Capture,
    run: RunFolder,
    console: Console,
    attempt: CameraSolving | None,
    started: float,
) -> int:
    """All that comes once the input was found good."""
    with exit_on_interrupt(console, PROGRAM, run.release):
        with console.status("loading torch"):
            from apps.cli.device import CUDA_SLOW_WARNING, resolve_device, set_threads
            from apps.run.report_writer import RunInfo, write_report
            from apps.run.training_session import TrainingSession
            from avatar.backends import backend_for

            threads = set_threads(arguments.threads)
        with console.status("compiling kernels (slow on the first run only)"):
            device = resolve_device(arguments.device)
            backend_for(device)
        if device.type == "cuda":
            console.warning(CUDA_SLOW_WARNING)
    if attempt is not None:
        recording = attempt.wait_before_training(recording, console)
    with exit_on_interrupt(console, PROGRAM, run.release):
        trainer, recall, notes = _new_or_resumed_trainer(arguments, recording, run, console)
        _warm_up(trainer, console)
        _announce_duration(arguments, recording, trainer, console)
        viewer = _open_viewer(arguments, recording, run, console)
    run.start_run(resume=arguments.resume)
    try:
        kept = nullcontext() if attempt is None else attempt.save_on_exit(recording, run, console)
        with kept, stop_on_interrupt(console) as stop:
            lesson = TrainingSession(
                trainer, recording, run, console, stop, notes,
                observers=() if viewer is None else (viewer,),
            )  # fmt: skip
            learnt, taken = _train_and_bake(lesson, recall, recording, run, console)
            if attempt is not None:
                recording = attempt.wait_after_training(recording, run, console, stop)
            startup = (learnt.meter.first_frame_at or started) - started
            note = RunInfo(command=arguments.as_json(), startup_seconds=startup, threads=threads)
            delivered = write_report(learnt, taken, recording, run, note, console)
            if arguments.json is not None:
                write_text_atomically(
                    arguments.json, delivered.report.to_json(), replace=arguments.may_replace_json
                )
            code = _print_results(delivered, run, console, interrupted=stop.is_set())
        if viewer is not None and code == DONE:
            console.info(f"The page stays at {viewer.page.address}. Ctrl-C ends it.")
            viewer.serve_until_interrupt(lesson)
        if code == DONE and attempt is not None and attempt.refused is not None:
            raise CommandExit(f"{attempt.refused} The avatar was learnt without.", BAD_INPUT)
        return code
    except (OSError, KeyboardInterrupt) as error:
        error.add_note(run.describe_remaining_files())
        raise
    finally:
        if viewer is not None:
            viewer.close()


def _open_capture(arguments: IngestArguments) -> Capture:
    """What is to be learnt from; if it is refused, with what might mend it."""
    try:
        return arguments.open_capture()
    except InputError as error:
        mend = correction_hint(arguments.capture_inputs())
        if not mend:
            raise
        raise InputError(f"{error} {mend}") from error


def _describe_capture(recording: Capture) -> str:
    source, size = recording.source, recording.source.size_px
    count = "frames" if source.frame_count is None else f"{source.frame_count} frames"
    return (
        f"{recording.paths.video}: {count} of {size[0]}x{size[1]} px, {len(recording.motion)} "
        f"poses, body {recording.shaped.body.family}, camera: {recording.cameras.source}"
    )


def _new_or_resumed_trainer(
    arguments: IngestArguments, recording: Capture, run: RunFolder, console: Console
) -> "tuple[Trainer, int, dict[str, Any]]":
    """The trainer, how many frames it has seen of this video, and what checkpoints keep."""
    from apps.cli.device import resolve_device
    from apps.run.continual_learning import EarlierVideos
    from apps.run.training_session import new_trainer
    from avatar.training import checkpoint

    device, video = resolve_device(arguments.device), _video_identity(recording)
    seconds = arguments.training_seconds(recording)
    if arguments.resume and not run.has_checkpoint():
        console.info(f"There is no checkpoint in {run.path}: starting afresh.")
    if not (arguments.resume and run.has_checkpoint()):
        trainer = new_trainer(
            recording, seconds=seconds, steps=arguments.steps, seed=arguments.seed,
            refine_poses=arguments.refine_poses, hold_every=arguments.hold_out, device=device,
        )  # fmt: skip
        return trainer, 0, {"video": video, "name": recording.paths.video.name}
    trainer, notes = checkpoint.load(run.checkpoint, device)
    _check_same_body(trainer, recording, run)
    unit, budget = ("seconds", seconds) if arguments.steps is None else ("steps", arguments.steps)
    had = trainer.wall_seconds if arguments.steps is None else trainer.steps
    extension = EarlierVideos(run, notes)
    if notes.get("video") == video:
        before = notes.get("before", {"frames": 0, "seconds": 0.0, "steps": 0})
        earlier, seen = before[unit], trainer.frames_seen - before["frames"]
        console.info(f"Going on after {had - earlier:.0f} {unit} of training.")
        if had - earlier >= budget:
            console.warning(
                f"The run has had {had - earlier:.0f} of {budget:.0f} {unit}; only its package "
                f"and report are written again. Give more --{unit} to go on learning."
            )
        extension.restore_key_frames(trainer, console)
    else:
        console.info(f"Adding another video to an avatar that has learnt for {had:.0f} {unit}.")
        extension.start_new_video(trainer, console)
        notes["name"] = recording.paths.video.name
        earlier, seen, notes["video"] = had, 0, video
    trainer.config = replace(
        trainer.config,
        seconds=seconds + earlier,
        steps=None if arguments.steps is None else arguments.steps + int(earlier),
        refine_poses=arguments.refine_poses,
    )
    return trainer, seen, notes


def _check_same_body(trainer: "Trainer", recording: Capture, run: RunFolder) -> None:
    """Raises if the poses are for another body than the checkpoint's.

    Raises:
        InputError: If they are.
    """
    apart = abs(trainer.avatar.rig.rest_joints - recording.shaped.joints).max()
    if apart > JOINT_TOLERANCE_M:
        raise InputError(
            f"The avatar in {run.path} has another body than these poses, with joints up to "
            f"{100.0 * apart:.1f} cm elsewhere, and {run.body_file.name}, which would say which, is "
            "not there. Learn the avatar anew (--overwrite)."
        )


def _video_identity(recording: Capture) -> str:
    """By which a checkpoint knows the video again; what a camera sees is new every time."""
    source = recording.source
    if camera_address(source.path) is not None:
        return f"{source.path} {source.started_at:.3f}"
    return str(source.path.resolve())


def _warm_up(trainer: "Trainer", console: Console) -> None:
    from avatar.training.warmup import warm_up
    from export.bake import bake_kernels

    with console.status("warming up"):
        warm_up(trainer)
        bake_kernels.warm_up()


def _announce_duration(
    arguments: IngestArguments, recording: Capture, trainer: "Trainer", console: Console
) -> None:
    """Says how long it will take: learning, and what comes after it."""
    from apps.cli.console import format_duration
    from apps.run.time_estimate import expected_held_out, post_training_seconds
    from avatar.evaluation.held_out import MAX_HELD_OUT

    source, config, longest = recording.source, trainer.config, max(recording.source.size_px)
    held = expected_held_out(source.frame_count, arguments.hold_out, MAX_HELD_OUT)
    rest = post_training_seconds(
        held, min(longest, recording.size_px or longest), fit_poses=config.refine_poses
    )
    seconds = max(0.0, config.seconds - trainer.wall_seconds)
    learning = f"{seconds:.0f} s" if seconds >= 10.0 else f"{seconds:.1g} s"
    if config.steps:
        learning = f"{config.steps - trainer.steps} steps"
    console.info(
        f"{learning} of learning, then about {format_duration(rest)} for the package and the scores, if "
        "nothing else needs this machine."
    )


def _open_viewer(
    arguments: IngestArguments, recording: Capture, run: RunFolder, console: Console
) -> "LiveViewer | None":
    if arguments.view is None:
        return None
    from apps.view.live_viewer import LiveViewer

    return LiveViewer(recording, run, console, arguments.view)


def _train_and_bake(
    session: "TrainingSession",
    restore_count: int,
    recording: Capture,
    run: RunFolder,
    console: Console,
) -> "tuple[TrainingResult, PackageSnapshot]":
    """Learns and writes the package: where a video was waited for, at once, and later a finer one.

    Scores come after the first package, which need not wait for them.
    """
    from apps.run.package_snapshot import prefer_final, validation_views, write_package_snapshot

    learnt, hasty = session.train(restore_count=restore_count), recording.source.paced
    _check_trained(learnt, recording)
    views, trainer = validation_views(learnt.held_out, recording), learnt.trainer
    with console.progress("writing the package", 1.0) as bar, session.checkpointing():
        mark = learnt.curve[-1] if learnt.curve else None
        taken = write_package_snapshot(
            trainer, run.package, views, curve_point=mark, quick=hasty, progress=bar.set_share
        )
    learnt = session.with_scores(learnt)
    if hasty:
        with console.progress("writing the final package, with finer detail", 1.0) as bar:
            mark = learnt.curve[-1] if learnt.curve else None
            last = write_package_snapshot(
                trainer, run.package, views, curve_point=mark, progress=bar.set_share
            )
            taken = prefer_final(taken, last)
    return learnt, taken


def _check_trained(result: "TrainingResult", recording: Capture) -> None:
    """Raises if there is nothing to write."""
    if result.is_trained:
        return
    if result.interrupted:
        raise CommandExit("stopped before anything was learnt; no avatar was written.", INTERRUPTED)
    reasons = Counter(drop.reason for drop in result.meter.dropped)
    told = ", ".join(f"{count} x {reason}" for reason, count in reasons.most_common(3))
    raise CommandExit(
        f"no frame of {recording.source.path} could be used ({told or 'it has none'}); at least "
        "two usable frames were expected. No avatar was written.",
        BAD_INPUT,
    )


def _print_results(
    outcome: "RunOutcome", run: RunFolder, console: Console, *, interrupted: bool
) -> int:
    """Names what was made, and what it is worth.

    Raises:
        Stop: If there is no package, or it holds no usable avatar.
    """
    from apps.report.report_schema import format_psnr

    held, score = outcome.report.held_out, "no frame was held out to score it"
    if held.psnr is not None:
        score = f"held out {format_psnr(held.psnr, held.verdict)}"
    fitted = outcome.report.held_out_refined
    if fitted is not None and fitted.psnr is not None:
        score += f", in poses fitted to those frames {format_psnr(fitted.psnr, fitted.verdict)}"
    seconds = outcome.report.training.wall_seconds
    console.info(f"Learnt for {seconds:.1f} s, {outcome.report.training.steps} steps; {score}.")
    if outcome.refusal is None:
        console.print_artifact("package", run.package)
    console.print_artifact("report", run.report_json)
    console.print_artifact("look at it", run.report_html)
    console.print_artifact("checkpoint", run.checkpoint)
    unusable = outcome.refusal or outcome.failure
    if unusable is not None:
        raise CommandExit(unusable, INTERRUPTED if interrupted else NO_AVATAR)
    return INTERRUPTED if interrupted else DONE


if __name__ == "__main__":
    sys.exit(main())

"""ia-ingest: a recorded video of one person walks in, an avatar walks out."""

import sys
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from apps.checking.first_look import first_look, hint
from apps.ingest_arguments import VIEW_PORT, IngestArguments
from apps.learning.run_folder import RunFolder
from apps.recording.recording import Recording
from apps.solving.attempt import Attempt, attempted
from apps.terminal.command_line import parsed
from apps.terminal.console import Console
from apps.terminal.exit_codes import BAD_INPUT, DONE, INTERRUPTED, NO_AVATAR, Stop, exit_code
from apps.terminal.interrupt import asked_to_stop, nothing_to_save
from apps.terminal.port import with_port
from capture.atomic_files import write_text
from capture.camera_device import camera_address
from capture.errors import BadInput

PROGRAM = "ia-ingest"
SAME_JOINTS_M = 1e-3

if TYPE_CHECKING:  # torch is loaded after --help has been answered
    from apps.learning.deliver import Delivered
    from apps.learning.learn import Lesson
    from apps.learning.learnt import Learnt
    from apps.learning.snapshot import Snapshot
    from apps.view.viewer import Viewer
    from avatar.trainer import Trainer


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    words = with_port(sys.argv[1:] if arguments is None else arguments, "--view", VIEW_PORT)
    given = parsed(IngestArguments, PROGRAM, words)
    return exit_code(PROGRAM, lambda: ingest(given, Console()))


def ingest(given: IngestArguments, console: Console) -> int:
    """Does what the arguments say.

    Raises:
        BadInput: If the input cannot be used; nothing was written then.
        OSError: If the disk is full; the newest checkpoint is kept.
        Stop: If there is no avatar to show.
    """
    started = time.perf_counter()
    given.check()
    run = given.run_folder()
    run.check(given.wanted().inputs(), resume=given.resume, overwrite=given.overwrite)
    with run.claimed(console, resume=given.resume, overwrite=given.overwrite):
        with console.waiting("opening video and poses"):
            recording = _opened(given)
        console.say(_described(recording))
        for note in recording.notes:
            console.warn(note)
        if not (given.resume and run.has_checkpoint()):
            first_look(recording, given.wanted(), console, force=given.force)
        with attempted(given.solve_job(recording), recording, run) as attempt:
            return _learnt_and_delivered(given, recording, run, console, attempt, started)


def _learnt_and_delivered(
    given: IngestArguments,
    recording: Recording,
    run: RunFolder,
    console: Console,
    attempt: Attempt | None,
    started: float,
) -> int:
    """All that comes once the input was found good."""
    with nothing_to_save(console, PROGRAM, run.abandon):
        with console.waiting("loading torch"):
            from apps.learning.deliver import RunNote, deliver
            from apps.learning.learn import Lesson
            from apps.terminal.device import SLOW_ON_CUDA, device_for
            from apps.terminal.threads import use_threads
            from avatar.kernels.choice import backend_for

            threads = use_threads(given.threads)
        with console.waiting("compiling kernels (slow on the first run only)"):
            device = device_for(given.device)
            backend_for(device)
        if device.type == "cuda":
            console.warn(SLOW_ON_CUDA)
    if attempt is not None:
        recording = attempt.before(recording, console)
    with nothing_to_save(console, PROGRAM, run.abandon):
        trainer, recall, notes = _trainer(given, recording, run, console)
        _warm_up(trainer, console)
        _announce(given, recording, trainer, console)
        viewer = _viewer(given, recording, run, console)
    run.begin(resume=given.resume)
    try:
        kept = nullcontext() if attempt is None else attempt.kept(recording, run, console)
        with kept, asked_to_stop(console) as stop:
            lesson = Lesson(
                trainer, recording, run, console, stop, notes,
                watchers=() if viewer is None else (viewer,),
            )  # fmt: skip
            learnt, taken = _taught(lesson, recall, recording, run, console)
            if attempt is not None:
                recording = attempt.after(recording, run, console, stop)
            startup = (learnt.meter.first_at or started) - started
            note = RunNote(command=given.as_json(), startup_seconds=startup, threads=threads)
            delivered = deliver(learnt, taken, recording, run, note, console)
            if given.json is not None:
                write_text(given.json, delivered.report.to_json(), replace=given.replaces_json)
            code = _conclude(delivered, run, console, interrupted=stop.is_set())
        if viewer is not None and code == DONE:
            console.say(f"The page stays at {viewer.page.address}. Ctrl-C ends it.")
            viewer.stay(lesson)
        if code == DONE and attempt is not None and attempt.refused is not None:
            raise Stop(f"{attempt.refused} The avatar was learnt without.", BAD_INPUT)
        return code
    except (OSError, KeyboardInterrupt) as error:
        error.add_note(run.what_is_kept())
        raise
    finally:
        if viewer is not None:
            viewer.close()


def _opened(given: IngestArguments) -> Recording:
    """What is to be learnt from; if it is refused, with what might mend it."""
    try:
        return given.recording()
    except BadInput as error:
        mend = hint(given.wanted())
        if not mend:
            raise
        raise BadInput(f"{error} {mend}") from error


def _described(recording: Recording) -> str:
    source, size = recording.source, recording.source.size_px
    count = "frames" if source.frame_count is None else f"{source.frame_count} frames"
    return (
        f"{recording.paths.video}: {count} of {size[0]}x{size[1]} px, {len(recording.motion)} "
        f"poses, body {recording.shaped.body.family}, camera: {recording.cameras.source}"
    )


def _trainer(
    given: IngestArguments, recording: Recording, run: RunFolder, console: Console
) -> "tuple[Trainer, int, dict[str, Any]]":
    """The trainer, how many frames it has seen of this video, and what checkpoints keep."""
    from apps.learning.extension import Extension
    from apps.learning.learn import new_trainer
    from apps.terminal.device import device_for
    from avatar import checkpoint

    device, video = device_for(given.device), _name_of(recording)
    seconds = given.training_seconds(recording)
    if given.resume and not run.has_checkpoint():
        console.say(f"There is no checkpoint in {run.path}: starting afresh.")
    if not (given.resume and run.has_checkpoint()):
        trainer = new_trainer(
            recording, seconds=seconds, steps=given.steps, seed=given.seed,
            refine_poses=given.refine_poses, hold_every=given.hold_out, device=device,
        )  # fmt: skip
        return trainer, 0, {"video": video, "name": recording.paths.video.name}
    trainer, notes = checkpoint.load(run.checkpoint, device)
    _check_person(trainer, recording, run)
    unit, budget = ("seconds", seconds) if given.steps is None else ("steps", given.steps)
    had = trainer.wall_seconds if given.steps is None else trainer.steps
    extension = Extension(run, notes)
    if notes.get("video") == video:
        before = notes.get("before", {"frames": 0, "seconds": 0.0, "steps": 0})
        earlier, seen = before[unit], trainer.frames_seen - before["frames"]
        console.say(f"Going on after {had - earlier:.0f} {unit} of training.")
        if had - earlier >= budget:
            console.warn(
                f"The run has had {had - earlier:.0f} of {budget:.0f} {unit}; only its package "
                f"and report are written again. Give more --{unit} to go on learning."
            )
        extension.recall(trainer, console)
    else:
        console.say(f"Adding another video to an avatar that has learnt for {had:.0f} {unit}.")
        extension.begin(trainer, console)
        notes["name"] = recording.paths.video.name
        earlier, seen, notes["video"] = had, 0, video
    trainer.config = replace(
        trainer.config,
        seconds=seconds + earlier,
        steps=None if given.steps is None else given.steps + int(earlier),
        refine_poses=given.refine_poses,
    )
    return trainer, seen, notes


def _check_person(trainer: "Trainer", recording: Recording, run: RunFolder) -> None:
    """Raises if the poses are for another body than the checkpoint's.

    Raises:
        BadInput: If they are.
    """
    apart = abs(trainer.avatar.rig.rest_joints - recording.shaped.joints).max()
    if apart > SAME_JOINTS_M:
        raise BadInput(
            f"The avatar in {run.path} has another body than these poses, with joints up to "
            f"{100.0 * apart:.1f} cm elsewhere, and {run.person.name}, which would say which, is "
            "not there. Learn the avatar anew (--overwrite)."
        )


def _name_of(recording: Recording) -> str:
    """By which a checkpoint knows the video again; what a camera sees is new every time."""
    source = recording.source
    if camera_address(source.path) is not None:
        return f"{source.path} {source.started_at:.3f}"
    return str(source.path.resolve())


def _warm_up(trainer: "Trainer", console: Console) -> None:
    from avatar.warm import warm_up
    from export import compiled

    with console.waiting("warming up"):
        warm_up(trainer)
        compiled.warm_up()


def _announce(
    given: IngestArguments, recording: Recording, trainer: "Trainer", console: Console
) -> None:
    """Says how long it will take: learning, and what comes after it."""
    from apps.learning.remaining import after_learning_s, held_out_of
    from apps.terminal.console import duration
    from avatar.hold import MOST_HELD

    source, config, longest = recording.source, trainer.config, max(recording.source.size_px)
    held = held_out_of(source.frame_count, given.hold_out, MOST_HELD)
    rest = after_learning_s(
        held, min(longest, recording.size_px or longest), fitted=config.refine_poses
    )
    seconds = max(0.0, config.seconds - trainer.wall_seconds)
    learning = f"{seconds:.0f} s" if seconds >= 10.0 else f"{seconds:.1g} s"
    if config.steps:
        learning = f"{config.steps - trainer.steps} steps"
    console.say(
        f"{learning} of learning, then about {duration(rest)} for the package and the scores, if "
        "nothing else needs this machine."
    )


def _viewer(
    given: IngestArguments, recording: Recording, run: RunFolder, console: Console
) -> "Viewer | None":
    if given.view is None:
        return None
    from apps.view.viewer import Viewer

    return Viewer(recording, run, console, given.view)


def _taught(
    lesson: "Lesson", recall: int, recording: Recording, run: RunFolder, console: Console
) -> "tuple[Learnt, Snapshot]":
    """Learns and writes the package: where a video was waited for, at once, and later a finer one.

    Scores come after the first package, which need not wait for them.
    """
    from apps.learning.snapshot import finer, snapshot, views_of

    learnt, hasty = lesson.learn(recall=recall), recording.source.paced
    _check_learnt(learnt, recording)
    views, trainer = views_of(learnt.held, recording), learnt.trainer
    with console.bar("writing the package", 1.0) as bar, lesson.saving():
        mark = learnt.curve[-1] if learnt.curve else None
        taken = snapshot(trainer, run.package, views, mark=mark, hasty=hasty, progress=bar.share)
    learnt = lesson.scored(learnt)
    if hasty:
        with console.bar("writing the final package, with finer detail", 1.0) as bar:
            mark = learnt.curve[-1] if learnt.curve else None
            last = snapshot(trainer, run.package, views, mark=mark, progress=bar.share)
            taken = finer(taken, last)
    return learnt, taken


def _check_learnt(learnt: "Learnt", recording: Recording) -> None:
    """Raises if there is nothing to write."""
    if learnt.trained:
        return
    if learnt.interrupted:
        raise Stop("stopped before anything was learnt; no avatar was written.", INTERRUPTED)
    reasons = Counter(drop.reason for drop in learnt.meter.dropped)
    told = ", ".join(f"{count} x {reason}" for reason, count in reasons.most_common(3))
    raise Stop(
        f"no frame of {recording.source.path} could be used ({told or 'it has none'}); at least "
        "two usable frames were expected. No avatar was written.",
        BAD_INPUT,
    )


def _conclude(
    delivered: "Delivered", run: RunFolder, console: Console, *, interrupted: bool
) -> int:
    """Names what was made, and what it is worth.

    Raises:
        Stop: If there is no package, or it holds no usable avatar.
    """
    from apps.reporting.report import decibels

    held, score = delivered.report.held_out, "no frame was held out to score it"
    if held.psnr is not None:
        score = f"held out {decibels(held.psnr, held.verdict)}"
    fitted = delivered.report.held_out_refined
    if fitted is not None and fitted.psnr is not None:
        score += f", in poses fitted to those frames {decibels(fitted.psnr, fitted.verdict)}"
    seconds = delivered.report.training.wall_seconds
    console.say(f"Learnt for {seconds:.1f} s, {delivered.report.training.steps} steps; {score}.")
    if delivered.refused is None:
        console.made("package", run.package)
    console.made("report", run.report)
    console.made("look at it", run.page)
    console.made("checkpoint", run.checkpoint)
    unusable = delivered.refused or delivered.failure
    if unusable is not None:
        raise Stop(unusable, INTERRUPTED if interrupted else NO_AVATAR)
    return INTERRUPTED if interrupted else DONE


if __name__ == "__main__":
    sys.exit(main())

"""ia-evaluate: score avatars, by renderer and player, as a table."""

import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from apps.cli.capture_options import parse_frame_range
from apps.cli.command_line import parse_arguments
from apps.cli.console import Console
from apps.cli.exit_codes import DONE, INTERRUPTED, NO_AVATAR, CommandExit, run_command
from apps.evaluation.evaluate_arguments import EvaluateArguments
from apps.run.run_folder import RunFolder
from capture.input_error import InputError

if TYPE_CHECKING:  # torch is loaded after --help has been answered
    from apps.evaluation.evaluation_frames import EvaluationFrames
    from apps.evaluation.people_snapshot import DatasetSubject
    from apps.evaluation.score_table import AvatarEvaluation
    from avatar.training.trainer import Trainer


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    given = parse_arguments(EvaluateArguments, "ia-evaluate", argv)
    return run_command("ia-evaluate", lambda: evaluate(given, Console()))


def evaluate(arguments: EvaluateArguments, console: Console) -> int:
    """Score avatars and print the table.

    Raises:
        InputError: If an input is missing, unreadable or does not match the others.
        OSError: If the disk is full.
    """
    arguments.validate()
    with console.status("loading torch"):
        from apps.cli.interrupt import stop_on_interrupt
        from apps.evaluation.score_table import evaluations_to_json, markdown_table
        from capture.atomic_files import write_text_atomically

    found: list[AvatarEvaluation] = []
    with stop_on_interrupt(console, "the table shows the frames scored by now") as stop:
        found += (
            evaluation
            for evaluation in _evaluate_all(arguments, console, stop)
            if any(row.scores for row in evaluation.rows)
        )
    if not found:
        if stop.is_set():
            return INTERRUPTED
        raise InputError("No frame shows the person, so there is nothing to score.")
    table = markdown_table(found)
    print(table, end="")  # noqa: T201 - the table goes to stdout, for scripts
    if arguments.json is not None:
        write_text_atomically(
            arguments.json, evaluations_to_json(found), replace=arguments.overwrite
        )
    if arguments.markdown is not None:
        write_text_atomically(arguments.markdown, table, replace=arguments.overwrite)
    return INTERRUPTED if stop.is_set() else DONE


def _evaluate_all(
    arguments: EvaluateArguments, console: Console, stop: threading.Event
) -> "Iterator[AvatarEvaluation]":
    from apps.evaluation.people_snapshot import find_subjects

    for path in arguments.targets:
        if stop.is_set():
            return
        run = RunFolder(path=path)
        if path.is_file():
            yield _evaluate_package(path, arguments, console, stop)
        elif run.has_checkpoint():
            yield _evaluate_run(run, arguments, console, stop)
        elif subjects := find_subjects(path):
            if arguments.on is not None:
                raise InputError(f"{path} is a dataset with its own test frames; omit --on.")
            for subject, place in subjects:
                run = _run_folder_of(subject, path, arguments)
                if not stop.is_set() and _train_subject(subject, place, run, arguments, console):
                    yield _evaluate_subject(subject, place, run, arguments, console, stop)
                else:
                    stop.set()
        else:
            raise InputError(
                f"{path} is neither a run (with checkpoint/), nor an .iavatar package, nor a "
                "folder with subjects of PeopleSnapshot (such as male-3-casual)."
            )


def _evaluate_package(
    path: Path, arguments: EvaluateArguments, console: Console, stop: threading.Event
) -> "AvatarEvaluation":
    """Score the player alone, on the capture of --on."""
    from apps.evaluation.avatar_scorer import evaluate_avatar
    from apps.evaluation.evaluation_frames import capture_frames

    if arguments.on is None:
        raise InputError(
            f"{path} is a package, which holds no frames: pass a capture of the same person with "
            "--on, or the run's folder."
        )
    beside = RunFolder(path=path.parent).body_file
    person = beside if beside.is_file() else None
    frames = capture_frames(arguments.capture_inputs(arguments.on), person, arguments.size)
    return evaluate_avatar(str(path), frames, None, path, console, stop, fit_poses=False)


def _evaluate_run(
    run: RunFolder, arguments: EvaluateArguments, console: Console, stop: threading.Event
) -> "AvatarEvaluation":
    """Score renderer and player on the run's held-out frames, or on the capture of --on."""
    from apps.evaluation.evaluation_frames import (
        capture_frames,
        held_out_frames,
        trained_longer_side_px,
    )

    if arguments.on is None:
        frames = held_out_frames(run, arguments.size)
    else:
        person = run.body_file if run.body_file.is_file() else None
        frames = capture_frames(
            arguments.capture_inputs(arguments.on),
            person,
            arguments.size or trained_longer_side_px(run),
        )
    return _evaluate_renderer_and_player(str(run.path), run, frames, arguments, console, stop)


def _run_folder_of(
    subject: "DatasetSubject", dataset: Path, arguments: EvaluateArguments
) -> RunFolder:
    """Return the folder of a subject's run."""
    above = arguments.out or Path("runs") / dataset.resolve().name
    return RunFolder(path=above / subject.name)


def _evaluate_subject(
    subject: "DatasetSubject",
    folder: Path,
    run: RunFolder,
    arguments: EvaluateArguments,
    console: Console,
    stop: threading.Event,
) -> "AvatarEvaluation":
    """Score a trained subject on the paper's test frames."""
    from apps.evaluation.evaluation_frames import capture_frames
    from apps.evaluation.people_snapshot import LONGER_SIDE_PX, TEST_POSES, subject_poses

    inputs = replace(
        arguments.capture_inputs(folder),
        poses=subject_poses(folder, TEST_POSES),
        frames=parse_frame_range(subject.test),
    )
    frames = capture_frames(inputs, run.body_file, arguments.size or LONGER_SIDE_PX)
    return replace(
        _evaluate_renderer_and_player(subject.name, run, frames, arguments, console, stop),
        paper=subject.paper,
    )


def _train_subject(
    subject: "DatasetSubject",
    folder: Path,
    run: RunFolder,
    arguments: EvaluateArguments,
    console: Console,
) -> bool:
    """Train a subject like ia-ingest, on all of the paper's training frames.

    Returns:
        Whether training is complete; after Ctrl-C the next evaluation continues it.
    """
    from apps.evaluation.evaluation_frames import is_trained
    from apps.evaluation.people_snapshot import LONGER_SIDE_PX, TRAIN_POSES, subject_poses
    from apps.ingest import ingest
    from apps.run.ingest_arguments import IngestArguments

    if is_trained(run, seconds=arguments.seconds, steps=arguments.steps):
        console.info(f"{subject.name} was trained before, in {run.path}.")
        return True
    console.info(f"Training {subject.name}.")
    words = IngestArguments(
        video=folder,
        poses=subject_poses(folder, TRAIN_POSES),
        frames=subject.train,
        body=arguments.body,
        out=run.path,
        resume=run.has_checkpoint(),
        seconds=arguments.seconds if arguments.steps is None else None,
        steps=arguments.steps,
        size=arguments.size or LONGER_SIDE_PX,
        hold_out=0,
        device=arguments.device,
    )
    try:
        return ingest(words, console) != INTERRUPTED
    except CommandExit as end:
        if end.code not in (NO_AVATAR, INTERRUPTED):
            raise
        console.warning(str(end))  # a failed avatar is scored, too
        return end.code == NO_AVATAR


def _evaluate_renderer_and_player(
    name: str,
    run: RunFolder,
    frames: "EvaluationFrames",
    arguments: EvaluateArguments,
    console: Console,
    stop: threading.Event,
) -> "AvatarEvaluation":
    from apps.evaluation.avatar_scorer import evaluate_avatar

    package = run.package if arguments.player and run.package.is_file() else None
    trainer = _load_trainer(run, arguments, console)
    return evaluate_avatar(
        name, frames, trainer, package, console, stop, fit_poses=arguments.fitted
    )


def _load_trainer(run: RunFolder, arguments: EvaluateArguments, console: Console) -> "Trainer":
    with console.status(f"loading {run.checkpoint}"):
        from apps.cli.device import resolve_device
        from avatar.training import checkpoint

        trainer, _ = checkpoint.load(run.checkpoint, resolve_device(arguments.device))
    return trainer


if __name__ == "__main__":
    sys.exit(main())

"""ia-evaluate: score avatars as a table."""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from capture.atomic_files import write_text_atomically
from capture.input_error import InputError
from instant_avatar.cli.command_line import (
    DONE,
    INTERRUPTED,
    NO_AVATAR,
    CommandExit,
    run_main,
    stop_on_interrupt,
)
from instant_avatar.cli.console import Console
from instant_avatar.cli.shared_options import parse_frame_range
from instant_avatar.evaluation.datasets import (
    DatasetSubject,
    SplitFrames,
    find_neuman,
    find_people_snapshot,
)
from instant_avatar.evaluation.evaluate_arguments import EvaluateArguments
from instant_avatar.ingest import ingest
from instant_avatar.run.ingest_arguments import IngestArguments
from instant_avatar.run.run_folder import RunFolder

if TYPE_CHECKING:  # torch is loaded after --help has been answered
    from instant_avatar.evaluation.evaluation_session import EvaluationSession
    from instant_avatar.evaluation.score_table import AvatarEvaluation


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main("ia-evaluate", EvaluateArguments, evaluate, argv)


def evaluate(arguments: EvaluateArguments, console: Console) -> int:
    """Score avatars, print the table, and write the files that were asked for."""
    arguments.validate()
    _check_targets(arguments.targets)
    with console.status("loading torch"):
        from avatar.evaluation.perceptual import Lpips
        from instant_avatar.evaluation.evaluation_session import EvaluationSession
        from instant_avatar.evaluation.score_table import (
            evaluation_conditions,
            evaluation_page,
            evaluations_to_json,
            markdown_table,
        )

    lpips = Lpips(arguments.lpips, arguments.lpips_weights)
    scored: list[AvatarEvaluation] = []
    if lpips.unavailable is not None:
        console.info(lpips.unavailable)
    with stop_on_interrupt(console, "the table shows the frames scored by now") as stop:
        session = EvaluationSession(arguments=arguments, console=console, stop=stop, lpips=lpips)
        scored += (
            evaluation
            for evaluation in _evaluate_all(session)
            if any(row.scores for row in evaluation.rows)
        )
    if not scored:
        if stop.is_set():
            return INTERRUPTED
        raise InputError("No frame shows the person, so there is nothing to score.")
    table, conditions = markdown_table(scored), evaluation_conditions(scored, lpips)
    print(table, end="")  # noqa: T201 - the table goes to stdout, for scripts
    if arguments.json is not None:
        text = evaluations_to_json(scored, conditions)
        write_text_atomically(arguments.json, text, replace=arguments.overwrite)
    if arguments.card is not None:
        page = evaluation_page(scored, conditions)
        write_text_atomically(arguments.card, page, replace=arguments.overwrite)
        console.print_artifact("page", arguments.card)
    return INTERRUPTED if stop.is_set() else DONE


def _check_targets(targets: Sequence[Path]) -> None:
    """Refuse folders that hold nothing to score, before torch is loaded."""
    for path in targets:
        is_avatar = path.is_file() or RunFolder(path=path).has_checkpoint()
        if not (is_avatar or find_people_snapshot(path) or find_neuman(path)):
            raise InputError(
                f"{path} is neither a run (with checkpoint/), nor an .iavatar package, nor a "
                "folder with subjects of PeopleSnapshot (such as male-3-casual) or of NeuMan (such "
                "as seattle)."
            )


def _evaluate_all(session: "EvaluationSession") -> "Iterator[AvatarEvaluation]":
    arguments, stop = session.arguments, session.stop
    for path in arguments.targets:
        if stop.is_set():
            return
        run = RunFolder(path=path)
        if path.is_file():
            frames = session.frames_of_capture(RunFolder(path=path.parent))
            yield session.evaluate(str(path), frames, package=path)
        elif run.has_checkpoint():
            yield _evaluate_run(run, session)
        else:
            if arguments.on is not None:
                raise InputError(f"{path} is a dataset with its own test frames; omit --on.")
            above = arguments.out or Path("runs") / path.resolve().name
            for subject in find_people_snapshot(path) or find_neuman(path):
                if not stop.is_set():
                    yield from _evaluate_subject(subject, above, session)


def _evaluate_run(run: RunFolder, session: "EvaluationSession") -> "AvatarEvaluation":
    from instant_avatar.evaluation.evaluation_frames import held_out_frames, trained_longer_side_px

    if session.arguments.on is None:
        frames = held_out_frames(run, session.arguments.size)
    else:
        frames = session.frames_of_capture(run, trained_longer_side_px(run))
    return session.evaluate_run(str(run.path), run, frames)


def _evaluate_subject(
    subject: DatasetSubject, above: Path, session: "EvaluationSession"
) -> "Iterator[AvatarEvaluation]":
    """Train a subject and score its test frames; nothing if training was stopped."""
    from instant_avatar.evaluation.evaluation_frames import capture_frames
    from instant_avatar.evaluation.frame_scoring import BACKGROUNDS

    arguments, run = session.arguments, RunFolder(path=above / subject.name)
    train, test = subject.open_splits(above / "captures", session.console)
    if session.stop.is_set() or not _train_subject(subject, train, run, session):
        session.stop.set()
        return
    inputs = replace(
        arguments.capture_inputs(test.folder),
        poses=test.poses,
        frames=parse_frame_range(test.frames),
    )
    frames = capture_frames(inputs, run.body_file, arguments.size or subject.size_px)
    yield session.evaluate_run(
        subject.name, run, frames, backgrounds=tuple(BACKGROUNDS), paper=subject.paper
    )


def _train_subject(
    subject: DatasetSubject, train: SplitFrames, run: RunFolder, session: "EvaluationSession"
) -> bool:
    """Train a subject like ia-ingest, on all of its training frames.

    Return False after Ctrl-C; the next evaluation continues the training.
    """
    from instant_avatar.evaluation.evaluation_frames import is_trained

    arguments, console = session.arguments, session.console
    if is_trained(run, seconds=arguments.seconds, steps=arguments.steps):
        console.info(f"{subject.name} was trained before, in {run.path}.")
        return True
    console.info(f"Training {subject.name}.")
    training = IngestArguments(
        video=train.folder,
        poses=train.poses,
        frames=train.frames,
        body=arguments.body,
        out=run.path,
        resume=run.has_checkpoint(),
        seconds=arguments.seconds if arguments.steps is None else None,
        steps=arguments.steps,
        size=arguments.size or subject.size_px,
        hold_out=0,
    )
    try:
        return ingest(training, console) != INTERRUPTED
    except CommandExit as end:
        if end.code not in (NO_AVATAR, INTERRUPTED):
            raise
        console.warning(str(end))  # a failed avatar is scored, too
        return end.code == NO_AVATAR


if __name__ == "__main__":
    sys.exit(main())

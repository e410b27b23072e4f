"""ia-evaluate: how good an avatar is, by renderer and player, as a table."""

import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from apps.evaluating.arguments import EvaluateArguments
from apps.learning.run_folder import RunFolder
from apps.terminal.command_line import parsed
from apps.terminal.console import Console
from apps.terminal.exit_codes import DONE, INTERRUPTED, NO_AVATAR, Stop, exit_code
from capture.errors import BadInput

if TYPE_CHECKING:  # torch is loaded after --help has been answered
    from apps.evaluating.frames import Frames
    from apps.evaluating.protocol import Subject
    from apps.evaluating.rows import Evaluation
    from avatar.trainer import Trainer


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    given = parsed(EvaluateArguments, "ia-evaluate", arguments)
    return exit_code("ia-evaluate", lambda: evaluate(given, Console()))


def evaluate(given: EvaluateArguments, console: Console) -> int:
    """Does what the arguments say.

    Raises:
        BadInput: If something is missing, unreadable or does not fit together.
        OSError: If the disk is full.
    """
    given.check()
    with console.waiting("loading torch"):
        from apps.evaluating.rows import to_json
        from apps.evaluating.table import table
        from apps.terminal.interrupt import asked_to_stop
        from capture.atomic_files import write_text

    found: list[Evaluation] = []
    with asked_to_stop(console, "the table shows what was scored") as stop:
        found += (
            evaluation
            for evaluation in _evaluations(given, console, stop)
            if any(row.scores for row in evaluation.rows)
        )
    if not found:
        if stop.is_set():
            return INTERRUPTED
        raise BadInput("There was no frame with a person in it, so there is nothing to score.")
    told = table(found)
    print(told, end="")  # noqa: T201 - the table goes to stdout, for scripts
    if given.json is not None:
        write_text(given.json, to_json(found), replace=given.overwrite)
    if given.markdown is not None:
        write_text(given.markdown, told, replace=given.overwrite)
    return INTERRUPTED if stop.is_set() else DONE


def _evaluations(
    given: EvaluateArguments, console: Console, stop: threading.Event
) -> "Iterator[Evaluation]":
    from apps.evaluating.protocol import subjects_in

    for path in given.what:
        if stop.is_set():
            return
        run = RunFolder(path=path)
        if path.is_file():
            yield _of_package(path, given, console, stop)
        elif run.has_checkpoint():
            yield _of_run(run, given, console, stop)
        elif subjects := subjects_in(path):
            if given.on is not None:
                raise BadInput(f"{path} is a dataset with test frames of its own; leave --on out.")
            for subject, place in subjects:
                run = _run_of(subject, path, given)
                if not stop.is_set() and _learn(subject, place, run, given, console):
                    yield _of_subject(subject, place, run, given, console, stop)
                else:
                    stop.set()
        else:
            raise BadInput(
                f"{path} is no run (it has no checkpoint/), no .iavatar package, and holds no "
                "subject of PeopleSnapshot (a folder named as male-3-casual)."
            )


def _of_package(
    path: Path, given: EvaluateArguments, console: Console, stop: threading.Event
) -> "Evaluation":
    """The player alone, beside frames that have to be named."""
    from apps.evaluating.frames import frames_on
    from apps.evaluating.judge import judged

    if given.on is None:
        raise BadInput(
            f"{path} is a package, which holds no frames: name a capture of the same person with "
            "--on, or give the run's folder."
        )
    beside = RunFolder(path=path.parent).person
    person = beside if beside.is_file() else None
    frames = frames_on(given.wanted(given.on), person, given.size)
    return judged(str(path), frames, None, path, console, stop, fits=False)


def _of_run(
    run: RunFolder, given: EvaluateArguments, console: Console, stop: threading.Event
) -> "Evaluation":
    """Renderer and player beside the run's own held-out frames, or another capture's."""
    from apps.evaluating.frames import frames_on, held_out_frames, learnt_px

    if given.on is None:
        frames = held_out_frames(run, given.size)
    else:
        person = run.person if run.person.is_file() else None
        frames = frames_on(given.wanted(given.on), person, given.size or learnt_px(run))
    return _both(str(run.path), run, frames, given, console, stop)


def _run_of(subject: "Subject", dataset: Path, given: EvaluateArguments) -> RunFolder:
    """Where a subject is learnt."""
    above = given.out or Path("runs") / dataset.resolve().name
    return RunFolder(path=above / subject.name)


def _of_subject(
    subject: "Subject",
    place: Path,
    run: RunFolder,
    given: EvaluateArguments,
    console: Console,
    stop: threading.Event,
) -> "Evaluation":
    """A subject of the dataset that was learnt, in the paper's frames."""
    from apps.evaluating.frames import frames_on
    from apps.evaluating.protocol import PIXELS, TEST_POSES, poses_of
    from apps.ingest_arguments import parsed_frames

    wanted = replace(
        given.wanted(place), poses=poses_of(place, TEST_POSES), frames=parsed_frames(subject.test)
    )
    frames = frames_on(wanted, run.person, given.size or PIXELS)
    return replace(_both(subject.name, run, frames, given, console, stop), paper=subject.paper)


def _learn(
    subject: "Subject", place: Path, run: RunFolder, given: EvaluateArguments, console: Console
) -> bool:
    """Makes the subject's run as ia-ingest does, from all of the paper's training frames.

    Returns:
        Whether it is whole; Ctrl-C leaves a part, with which the next evaluation goes on.
    """
    from apps.evaluating.frames import is_learnt
    from apps.evaluating.protocol import PIXELS, TRAIN_POSES, poses_of
    from apps.ingest import ingest
    from apps.ingest_arguments import IngestArguments

    if is_learnt(run, seconds=given.seconds, steps=given.steps):
        console.say(f"{subject.name} was learnt before, in {run.path}.")
        return True
    console.say(f"Learning {subject.name}.")
    words = IngestArguments(
        video=place,
        poses=poses_of(place, TRAIN_POSES),
        frames=subject.train,
        body=given.body,
        out=run.path,
        resume=run.has_checkpoint(),
        seconds=given.seconds if given.steps is None else None,
        steps=given.steps,
        size=given.size or PIXELS,
        hold_out=0,
        device=given.device,
    )
    try:
        return ingest(words, console) != INTERRUPTED
    except Stop as end:
        if end.code not in (NO_AVATAR, INTERRUPTED):
            raise
        console.warn(str(end))  # a poor avatar is scored like any other
        return end.code == NO_AVATAR


def _both(
    name: str,
    run: RunFolder,
    frames: "Frames",
    given: EvaluateArguments,
    console: Console,
    stop: threading.Event,
) -> "Evaluation":
    from apps.evaluating.judge import judged

    package = run.package if given.player and run.package.is_file() else None
    trainer = _trainer(run, given, console)
    return judged(name, frames, trainer, package, console, stop, fits=given.fitted)


def _trainer(run: RunFolder, given: EvaluateArguments, console: Console) -> "Trainer":
    with console.waiting(f"loading {run.checkpoint}"):
        from apps.terminal.device import device_for
        from avatar import checkpoint

        trainer, _ = checkpoint.load(run.checkpoint, device_for(given.device))
    return trainer


if __name__ == "__main__":
    sys.exit(main())

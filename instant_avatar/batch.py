"""ia-batch: learn an avatar from each of many captures, on this machine or on a cluster."""

import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from capture.input_error import counted
from instant_avatar.batching.batch_arguments import BatchArguments
from instant_avatar.batching.batch_folder import (
    RESULTS_NAME,
    BatchFolder,
    Results,
    describe_result,
    headline,
    summary_page,
)
from instant_avatar.batching.capture_discovery import find_captures, parse_options, split_paths
from instant_avatar.batching.ingest_attempt import run_attempts
from instant_avatar.batching.remote_files import RemoteFileError
from instant_avatar.cli.command_line import (
    DONE,
    NO_AVATAR,
    RESOURCE_UNAVAILABLE,
    CommandExit,
    parse_arguments,
    require_packages,
    run_command,
)
from instant_avatar.cli.console import Console

PROGRAM = "ia-batch"
PAGE_NAME = "summary.html"
"""The contact sheet."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    cut = words.index("--") if "--" in words else len(words)
    arguments = parse_arguments(BatchArguments, PROGRAM, words[:cut])

    def run() -> int:
        try:
            return batch(arguments, words[cut + 1 :], Console())
        except RemoteFileError as error:
            raise CommandExit(str(error), RESOURCE_UNAVAILABLE) from error

    return run_command(PROGRAM, run)


def batch(arguments: BatchArguments, ingest_words: Sequence[str], console: Console) -> int:
    """Find the captures, learn those that are missing, and sum up.

    `ingest_words`: options of ia-ingest for all captures. After an `InputError` nothing was
    started.
    """
    require_packages("ray", "fsspec", "torch")
    arguments.validate()
    parse_options(split_paths(ingest_words, "")[1])
    with console.status("looking for captures"):
        captures = find_captures(arguments.captures, ingest_words)
    arguments.check_apart(place for capture in captures for place in capture.places())
    folder = BatchFolder(arguments.out)
    with folder.claim(console):
        states = {c.name: folder.settled(c, again=arguments.again) for c in captures}
        waiting = [capture for capture in captures if states[capture.name] is None]
        console.info(
            f"{counted(len(states), 'capture')}, {len(states) - len(waiting)} settled before."
        )
        try:
            if waiting:
                with closing(run_attempts(waiting, arguments)) as attempts:
                    for attempt in attempts:
                        record = folder.place_attempt(attempt)
                        states[record.capture] = record
                        console.info(f"{record.capture}: {describe_result(record)}")
        finally:
            if folder.records:
                _sum_up(folder, states, console)
    done = all(record is not None and record.status == "done" for record in states.values())
    return DONE if done else NO_AVATAR


def _sum_up(folder: BatchFolder, results: Results, console: Console) -> None:
    folder.write_text(PAGE_NAME, summary_page(results, Path(folder.place).name))
    console.info(headline(results))
    console.print_artifact("results", f"{folder.place}/{RESULTS_NAME}")
    console.print_artifact("look at it", f"{folder.place}/{PAGE_NAME}")


if __name__ == "__main__":
    sys.exit(main())

"""ia-batch: learn an avatar from each of many captures, on this machine or on a cluster."""

import shlex
import signal
import sys
import tempfile
import threading
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, fields, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from apps.batching.batch_folder import BatchFolder
from apps.batching.batch_scheduler import (
    FIRST_NEED_MB,
    BatchLimits,
    BatchScheduler,
    CaptureState,
    LiveTable,
    plan_captures,
)
from apps.batching.capture_discovery import BATCH_OPTIONS, find_captures, resolve_option
from apps.batching.executors import RAY_LOCAL, AttemptExecutor, LocalExecutor, RayExecutor
from apps.batching.ingest_attempt import IngestJob
from apps.batching.remote_files import LOCK_NAME, RemoteFileError, is_url
from apps.batching.summary_page import BatchSummary, CorePrice, write_summary
from apps.cli.command_line import (
    DONE,
    INTERRUPTED,
    NO_AVATAR,
    RESOURCE_UNAVAILABLE,
    CommandExit,
    handle_signals,
    parse_arguments,
    run_command,
    stop_on_interrupt,
)
from apps.cli.console import Console, StderrConsole
from apps.cli.hardware import usable_cores
from apps.cli.shared_options import (
    Flag,
    check_disjoint_from_inputs,
    check_output_file,
    check_writable,
)
from apps.run.ingest_arguments import IngestArguments
from capture.input_error import InputError

PROGRAM = "ia-batch"
DEFAULT_CORES = 2
"""Cores per capture; the figures of the README are for two."""


@dataclass(frozen=True, kw_only=True)
class BatchArguments:
    """Learn an avatar from each of many captures, each as ia-ingest would, in its own process.

    Try it:

        ia-batch captures/ --out avatars

        ia-batch captures/ --out avatars --ray auto -- --steps 3000

    Captures are folders (a video or images/ with poses or masks), videos with poses beside them
    (anna.mp4, anna_poses.npz), bare videos, and rows of a manifest (.csv or .jsonl with a column
    capture, and options of ia-ingest). Words after -- are options of ia-ingest for all captures.

    The folder then holds a folder per capture, results.jsonl (a line per attempt), summary.html
    and summary.csv. Run the same command again to go on: what is done is left alone, what is new
    or has changed is learnt. See docs/batch.md.

    Exit codes: 0 every capture has an avatar; 1 some were refused or have failed; 2 bad input,
    nothing was started; 3 the disk is full, or another batch is writing into --out; 130 stopped.
    """

    captures: Annotated[
        Positional[tuple[str, ...]], arg(metavar="PLACE ...", help_behavior_hint="")
    ]
    """Folders, videos, manifests, or their URLs (s3://, gs://, https://)."""
    out: Annotated[str, arg(metavar="DIR", help_behavior_hint="")]
    """Folder, or URL, for avatars and results."""
    cores: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Cores per capture (default: 2, or as many as there are). One core per capture makes the most
    avatars per hour; give --steps then, because --seconds makes fewer steps on fewer cores."""
    memory: Annotated[float | None, arg(metavar="GB", help_behavior_hint="")] = None
    """Memory per capture; an attempt that takes more is killed (default: as measured in earlier
    captures, and at most half of the machine's)."""
    gpus: float = 1.0
    """GPUs per capture with --device cuda; a fraction shares one."""
    at_once: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Most captures at once (default: as many as cores and memory allow)."""
    limit: float = 3600.0
    """Seconds after which an attempt is killed; 0 for none."""
    retries: int = 2
    """Attempts after the first failed one; bad input is never tried again."""
    again: Flag = False
    """Try captures that were refused or have failed before again, too."""
    ray: Annotated[str | None, arg(metavar="[ADDRESS]", help_behavior_hint="")] = None
    """Run on a Ray cluster: auto, or HOST:PORT; without an address, or with `local`, one is started
    on this machine. Requires: pip install 'instant-avatar-stream[cluster]'."""
    index: Annotated[int | None, arg(metavar="I", help_behavior_hint="")] = None
    """Learn only every Nth capture, beginning with this one, from 0 (with --of N); for arrays of
    Slurm or Kubernetes."""
    of: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Number of parts of --index."""
    merge: Flag = False
    """Learn nothing: join the results of all parts, and write the summary."""
    scratch: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Folder on each node's own disk for runs and fetched captures (default: the temporary
    folder)."""
    disk: Annotated[float | None, arg(metavar="GB", help_behavior_hint="")] = None
    """Most disk space for fetched captures on a node (default: any)."""
    checkpoints: Flag = False
    """Keep checkpoints, too, about 35 MB each: ia-ingest --resume continues from them."""
    price: Annotated[str | None, arg(metavar="PRICE", help_behavior_hint="")] = None
    """Price of a core-hour for the summary, as in "0.04 EUR"."""

    def validate(self) -> None:
        """Check ranges and combinations.

        Raises:
            InputError: Naming the option.
        """
        if not self.captures:
            raise InputError("No captures were named; name a folder, a video or a manifest.")
        if self.price is not None:
            CorePrice.parse(self.price)
        for name, least in (("cores", 1), ("at_once", 1), ("retries", 0), ("limit", 0)):
            value = getattr(self, name)
            if value is not None and value < least:
                flag = name.replace("_", "-")
                raise InputError(f"--{flag} is {value}, but must be at least {least}.")
        for name in ("memory", "disk", "gpus"):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise InputError(f"--{name} is {value}, but must be positive.")
        if (self.index is None) != (self.of is None):
            raise InputError("--index and --of belong together: --index 0 --of 10.")
        if self.index is not None and self.of is not None and not 0 <= self.index < self.of:
            raise InputError(f"--index is {self.index}, but must lie between 0 and {self.of - 1}.")
        if self.merge and self.index is not None:
            raise InputError("--merge joins all parts; omit --index and --of.")
        inputs = [Path(place) for place in self.captures if not is_url(place)]
        if self.scratch is not None and self.ray is None:  # else it is on other machines
            place = self.scratch / LOCK_NAME
            check_output_file(place, "--scratch", inputs, overwrite=True, below=False)
        if not is_url(self.out):
            check_disjoint_from_inputs(Path(self.out), "--out", inputs)
            if Path(self.out).exists() and not Path(self.out).is_dir():
                raise InputError(f"--out {self.out} is a file; a folder was expected.")
            check_writable(Path(self.out), "--out")

    @property
    def part(self) -> tuple[int, int] | None:
        """Index and number of parts; None for the whole."""
        return None if self.index is None or self.of is None else (self.index, self.of)

    def limits(self) -> BatchLimits:
        """Return what attempts may use."""
        scratch = self.scratch or Path(tempfile.gettempdir(), f"{PROGRAM}-work")
        job = IngestJob(
            name="",
            video="",
            options={},
            cores=self.cores or min(DEFAULT_CORES, usable_cores()),
            limit_mb=None if self.memory is None else 1000.0 * self.memory,
            limit_s=self.limit or None,
            scratch=str(scratch.absolute()),
            disk_bytes=None if self.disk is None else int(1e9 * self.disk),
            checkpoint=self.checkpoints,
        )
        return BatchLimits(
            job=job, retries=self.retries, again=self.again, gpus=self.gpus, at_once=self.at_once
        )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    cut = words.index("--") if "--" in words else len(words)
    given = parse_arguments(BatchArguments, PROGRAM, fill_ray_address(words[:cut]))

    def run() -> int:
        try:
            return batch(given, words[cut + 1 :], StderrConsole())
        except RemoteFileError as error:
            raise CommandExit(str(error), RESOURCE_UNAVAILABLE) from error

    return run_command(PROGRAM, run)


def fill_ray_address(words: Sequence[str]) -> list[str]:
    """Insert `local` after a --ray without an address."""
    filled = []
    for word, after in zip(words, [*words[1:], ""], strict=False):
        is_address = after in ("auto", RAY_LOCAL) or (":" in after and not is_url(after))
        filled += [word, RAY_LOCAL] if word == "--ray" and not is_address else [word]
    return filled


def batch(arguments: BatchArguments, ingest_options: Sequence[str], rich: StderrConsole) -> int:
    """Find the captures, learn those that are missing, and sum up.

    Args:
        arguments: Of the command.
        ingest_options: Words for ia-ingest, for all captures.
        rich: Shows messages and the table.

    Raises:
        InputError: If no capture is found, or an option is wrong; nothing was started then.
        OSError: If the disk is full.
    """
    arguments.validate()
    if find_spec("torch") is None:  # said before anything is started
        raise ModuleNotFoundError(name="torch")
    console, folder = Console(rich), BatchFolder(arguments.out, arguments.part)
    common = parse_common_options(ingest_options)
    with console.status("looking for captures"):
        captures = find_captures(arguments.captures, common)
    if not is_url(arguments.out):  # of manifests, too
        named = {place for capture in captures for place in capture.paths()}
        check_disjoint_from_inputs(Path(arguments.out), "--out", sorted(named))
    if arguments.part is not None:
        captures = captures[arguments.index :: arguments.of]
    with folder.claim(console):
        states = plan_captures(captures, folder, arguments.limits())
        waiting = sum(state.status == "waiting" for state in states)
        console.info(f"{len(states)} captures, {len(states) - waiting} of them settled before.")
        stopped = False
        if waiting and not arguments.merge:
            states, stopped = _learn(arguments, states, folder, rich)
        return _sum_up(arguments, states, folder, console, stopped=stopped)


def parse_common_options(words: Sequence[str]) -> dict[str, object]:
    """Return the options of ia-ingest for all captures, without defaults.

    Raises:
        InputError: If one is wrong, or set by the batch itself.
        SystemExit: If the words cannot be parsed.
    """
    parsed = parse_arguments(IngestArguments, "ia-ingest", ["CAPTURE", *words])
    parsed.validate()
    options = {}
    for each in fields(IngestArguments):
        value = getattr(parsed, each.name)
        if each.name == "video" or value == each.default:
            continue
        if each.name in BATCH_OPTIONS:
            flag = each.name.replace("_", "-")
            raise InputError(f"--{flag} cannot be given for the captures of a batch. Omit it.")
        options[each.name] = resolve_option(each.name, value, Path.cwd().as_posix())
    return options


def _learn(
    arguments: BatchArguments,
    states: Sequence[CaptureState],
    folder: BatchFolder,
    rich: StderrConsole,
) -> tuple[list[CaptureState], bool]:
    """Learn what waits; return the states afterwards, and whether it was stopped.

    SIGTERM stops at once: Slurm and Kubernetes grant a few seconds only.
    """
    limits, kill = arguments.limits(), threading.Event()
    executor = _open_executor(arguments, limits.job)
    with (
        closing(executor),
        stop_on_interrupt(Console(rich), "captures that run are finished first") as stop,
        handle_signals({signal.SIGTERM: lambda *_: (stop.set(), kill.set())}),
        LiveTable(rich) as table,
    ):
        scheduler = BatchScheduler(states, folder, executor, limits, table)
        try:
            scheduler.run(stop, kill)
        except KeyboardInterrupt:
            kill.set()
            stop.set()
            scheduler.run(stop, kill)
    return list(scheduler.states.values()), stop.is_set()


def _open_executor(arguments: BatchArguments, job: IngestJob) -> AttemptExecutor:
    """Return what runs the attempts: this machine, or a Ray cluster."""
    if arguments.ray is None:
        return LocalExecutor()
    return RayExecutor(arguments.ray, replace(job, memory_mb=job.limit_mb or FIRST_NEED_MB))


def _sum_up(
    arguments: BatchArguments,
    states: Sequence[CaptureState],
    folder: BatchFolder,
    console: Console,
    *,
    stopped: bool,
) -> int:
    """Write the summary, unless this is a part; return the exit code."""
    price = None if arguments.price is None else CorePrice.parse(arguments.price)
    summary = BatchSummary.of(states, folder, price)
    console.info(summary.headline())
    console.print_artifact("results", f"{folder.place}/{folder.results_name}")
    if arguments.part is None:
        if arguments.merge:
            folder.merge()
        write_summary(summary, folder, Path(arguments.out.rstrip("/")).name)
        console.print_artifact("look at it", f"{folder.place}/summary.html")
    if stopped:
        console.info(f"Stopped. To go on: {shlex.join([PROGRAM, *sys.argv[1:]])}")
        return INTERRUPTED
    return DONE if all(state.status == "done" for state in states) else NO_AVATAR


if __name__ == "__main__":
    sys.exit(main())

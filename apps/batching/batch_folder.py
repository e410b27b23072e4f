"""The output folder of a batch: results of all attempts, avatars, and who may write there.

It is a local or shared folder, or a URL, whose results file and lock are then mirrored in a
temporary folder.
"""

import json
import os
import socket
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, final

from apps.batching.ingest_attempt import FAILED_NAME, PACKAGE_NAME, folder_of
from apps.batching.remote_files import (
    RemoteFileError,
    explain_errors,
    is_url,
    list_files,
    open_remote,
    read_text,
    send_files,
)
from apps.cli.command_line import RESOURCE_UNAVAILABLE, CommandExit
from apps.cli.console import Console
from apps.run.run_folder import claim_folder
from capture.atomic_files import (
    OutputFileList,
    atomic_folder,
    check_replaceable_folder,
    write_text_atomically,
)
from capture.input_error import InputError

RESULTS_NAME = "results.jsonl"
"""One line per attempt."""
FIRST_WORDS = b'{"capture": "'
"""How every results file begins."""
SUMMARY_NAMES = ("summary.csv", "summary.html")
"""What is written at the end of a batch."""
WRITTEN_NAMES = frozenset({RESULTS_NAME, *SUMMARY_NAMES})
"""Names that no capture may have."""
PARTS_NAME = "_parts"
"""Folder with a results file for each part of a batch that was split by --index and --of."""
REMOTE_LOCK_NAME = "_lock.json"
"""Name of the lock behind a URL; it exists as long as a batch writes there."""
PUSH_INTERVAL_S = 30.0
"""Interval at which the results are sent to a URL, seconds."""
ABANDONED_S = 600.0
"""Age from which a lock behind a URL no longer counts, seconds."""


@dataclass(frozen=True, kw_only=True)
class AttemptRecord:
    """A line of results.jsonl.

    Attributes:
        capture: Name of the capture.
        video: Where it lies.
        attempt: Number of the attempt at this input with these options, from 1.
        status: "done", "refused" (bad input, never tried again) or "failed".
        exit_code: Of ia-ingest; null if it was killed or lost.
        cause: Why there is no avatar; empty if there is one.
        input: Fingerprint of the capture's files.
        options: Fingerprint of its options.
        started, ended: Time of day, seconds since 1970.
        wall_s, core_s, peak_memory_mb: See `AttemptOutcome`.
        machine: Host, processor, cores, memory, and the cores that were asked for.
        figures: Quality and cost from report.json.
        part: "INDEX/OF" of a part of a batch; empty without parts.
    """

    capture: str
    video: str
    attempt: int
    status: str
    exit_code: int | None
    cause: str
    input: str
    options: str
    started: float
    ended: float
    wall_s: float = 0.0
    core_s: float = 0.0
    peak_memory_mb: float = 0.0
    machine: dict[str, Any] = field(default_factory=dict)
    figures: dict[str, Any] = field(default_factory=dict)
    part: str = ""

    @property
    def identity(self) -> tuple[str, float, str]:
        """What no other attempt shares."""
        return self.capture, self.started, self.part

    @property
    def reserved_core_s(self) -> float:
        """Core-seconds for which the machine was paid: wall time of the cores asked for."""
        return self.wall_s * float(self.machine.get("used_cores", 1))


@final
class BatchFolder:
    """The output folder of a batch, or of a part of one.

    Attributes:
        path: The local folder: --out itself, or the mirror of a URL.
        url: The URL, if --out is one.
        part: Index and number of parts; None for a whole batch.
    """

    def __init__(self, out: str, part: tuple[int, int] | None = None) -> None:
        """Name the folder; `claim` creates it."""
        self.url = out.rstrip("/") if is_url(out) else None
        self.path, self.part = Path(out), part
        self._records: dict[tuple[str, float, str], AttemptRecord] = {}
        self._packages: set[str] | None = None
        self._pushed_at = 0.0

    @property
    def place(self) -> str:
        """Path or URL, for messages."""
        return self.url or str(self.path)

    @property
    def part_text(self) -> str:
        """The part as "INDEX/OF"; empty for a whole batch."""
        return "" if self.part is None else f"{self.part[0]}/{self.part[1]}"

    @property
    def results_name(self) -> str:
        """Name of the results file that this process writes, relative to the folder."""
        if self.part is None:
            return RESULTS_NAME
        index, of = self.part
        return f"{PARTS_NAME}/{index:0{len(str(of))}d}-of-{of}/{RESULTS_NAME}"

    @property
    def records(self) -> list[AttemptRecord]:
        """All attempts of all parts, in the order of their start."""
        return sorted(self._records.values(), key=lambda record: record.started)

    @contextmanager
    def claim(self, console: Console) -> Iterator[None]:
        """Create and lock the folder, and read all results, during a block.

        A whole batch excludes everything else; parts exclude only themselves and whole batches.

        Raises:
            CommandExit: If another batch is writing here.
            InputError: If files of another program have the names of a batch's.
        """
        with ExitStack() as held:
            if self.url is not None:
                self.path = Path(held.enter_context(TemporaryDirectory(prefix="ia-batch-mirror-")))
            own = self.path / self.results_name
            self._check_names()
            if self.url is not None:
                held.enter_context(self._remote_lock())
                self._pull()
            if self.part is not None:
                held.enter_context(claim_folder(own.parent, console))
                held.enter_context(claim_folder(self.path, console, shared=True))
            else:
                held.enter_context(claim_folder(self.path, console))
                for part in sorted(self.path.glob(f"{PARTS_NAME}/*")):
                    held.enter_context(claim_folder(part, console))
                held.callback(OutputFileList(self.path).remove_if_empty)
            self._read()
            try:
                yield
            finally:
                self.push()

    def append(self, record: AttemptRecord) -> None:
        """Add a line to the results file, flushed to the disk."""
        line = json.dumps(vars(record), allow_nan=False)
        with (self.path / self.results_name).open("ab+") as file:
            torn = file.tell() > 0 and file.seek(-1, os.SEEK_END) and file.read(1) != b"\n"
            file.write((("\n" if torn else "") + line + "\n").encode())
            file.flush()
            os.fsync(file.fileno())
        self._records[record.identity] = record
        if self.url is not None and time.monotonic() - self._pushed_at > PUSH_INTERVAL_S:
            with suppress(RemoteFileError):  # the next push sends it
                self.push()

    def check_place(self, name: str) -> None:
        """Check that the folder of a capture may be written.

        Raises:
            InputError: If it holds files of another program.
        """
        if name in WRITTEN_NAMES:
            raise InputError(
                f"A capture cannot be called {name}, which is a file of the batch. Rename it, or "
                "give a name in a manifest (docs/batch.md)."
            )
        if self.url is None:
            for place in (self.path / name, self.path / FAILED_NAME / name):
                check_replaceable_folder(place)

    def place_files(self, name: str, files: dict[str, bytes], status: str) -> None:
        """Write the files of an attempt, as a whole; those of a failed one into `_failed`.

        Args:
            name: Name of the capture.
            files: Content by relative name.
            status: Of the attempt.
        """
        failed = self.path / FAILED_NAME / name
        if self.url is not None:
            if files:  # others were sent by the machine that made them
                send_files(f"{self.url}/{folder_of(name, status)}", files, last=PACKAGE_NAME)
            return
        if status == "done":
            OutputFileList(failed).remove_all()
            with suppress(OSError):  # a foreign file is in it
                failed.rmdir()
        if not files:
            return
        with atomic_folder(self.path / folder_of(name, status)) as part:
            for relative, content in files.items():
                (part / relative).parent.mkdir(parents=True, exist_ok=True)
                (part / relative).write_bytes(content)

    def has_package(self, name: str) -> bool:
        """Whether the avatar of a capture is there."""
        if self.url is None:
            return (self.path / name / PACKAGE_NAME).is_file()
        if self._packages is None:
            ending = f"/{PACKAGE_NAME}"
            files = list_files(self.url)
            self._packages = {path.rsplit("/", 2)[1] for path in files if path.endswith(ending)}
        return name in self._packages

    def write_text(self, name: str, text: str, *, replace: bool | None = None) -> None:
        """Write a text file into the folder, whole or not at all; see `AtomicFile`."""
        OutputFileList(self.path).create()
        write_text_atomically(self.path / name, text, replace=replace)
        if self.url is not None:
            send_files(self.url, {name: text.encode()})

    def merge(self) -> None:
        """Write the results of all parts into the results file of the whole."""
        lines = [json.dumps(vars(record)) + "\n" for record in self.records]
        self.write_text(RESULTS_NAME, "".join(lines), replace=True)

    def push(self) -> None:
        """Send the results file, and renew the lock, if the folder is a URL."""
        if self.url is None:
            return
        self._pushed_at = time.monotonic()
        own = self.path / self.results_name
        files = {self.results_name: own.read_bytes()} if own.exists() else {}
        send_files(self.url, files | {self._lock_name: self._lock_label()})

    def _check_names(self) -> None:
        """Raise if something of another program has the name of a file of the batch."""
        parts = self.path.glob(f"{PARTS_NAME}/*/{RESULTS_NAME}")
        wrong = [path for path in (self.path / RESULTS_NAME, *parts) if not _is_results(path)]
        listed = OutputFileList(self.path)
        summaries = [] if self.part is not None else [self.path / name for name in SUMMARY_NAMES]
        wrong += [p for p in summaries if os.path.lexists(p) and not listed.owns(p.name)]
        for path in wrong:
            raise InputError(
                f"{path} is not what ia-batch wrote, so it is not replaced. "
                "Move it elsewhere, or name another folder (--out)."
            )

    def _read(self) -> None:
        parts = sorted(self.path.glob(f"{PARTS_NAME}/*/{RESULTS_NAME}"))
        for path in (self.path / RESULTS_NAME, *parts):
            if path.exists():
                for record in read_records(path.read_text(encoding="utf-8").splitlines()):
                    self._records[record.identity] = record

    # --- behind a URL ----------------------------------------------------------------------------

    @property
    def _lock_name(self) -> str:
        return self.results_name.replace(RESULTS_NAME, REMOTE_LOCK_NAME)

    def _lock_label(self) -> bytes:
        since = time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime())
        label = {"host": socket.gethostname(), "process": os.getpid(), "at": time.time()}
        return json.dumps({**label, "since": since}).encode()

    @contextmanager
    def _remote_lock(self) -> Iterator[None]:
        """Create an object that only one process can create, and remove it at the end."""
        own = f"{self.url}/{self._lock_name}"
        system, path = open_remote(own)
        with explain_errors(own, "create"):
            try:
                system.pipe_file(path, self._lock_label(), mode="create")
            except FileExistsError:
                self._check_abandoned(own)
                system.pipe_file(path, self._lock_label())
        try:
            others = [f"{self.url}/{REMOTE_LOCK_NAME}"]
            if self.part is None:
                listed = list_files(f"{self.url}/{PARTS_NAME}")
                others = [name for name in listed if name.endswith(REMOTE_LOCK_NAME)]
            for lock in others:
                self._check_abandoned(lock)
            yield
        finally:
            with explain_errors(own, "remove"):
                system.rm_file(path)

    def _check_abandoned(self, lock: str) -> None:
        """Raise if a lock was renewed a short time ago."""
        system, path = open_remote(lock)
        try:
            label = json.loads(system.cat_file(path))
        except (FileNotFoundError, ValueError):
            return
        if time.time() - float(label["at"]) < ABANDONED_S:
            raise CommandExit(
                f"Another batch is writing into {self.url} (process {label['process']} on "
                f"{label['host']}, {label['since']} UTC). Wait until it ends; the lock of a killed "
                f"one counts no longer after {ABANDONED_S / 60:.0f} minutes.",
                RESOURCE_UNAVAILABLE,
            )

    def _pull(self) -> None:
        """Fetch the results of all parts."""
        assert self.url is not None
        names = [f"{self.url}/{RESULTS_NAME}"]
        names += [p for p in list_files(f"{self.url}/{PARTS_NAME}") if p.endswith(RESULTS_NAME)]
        known = list_files(names[0])
        for name in names[0 if known else 1 :]:
            local = self.path / name.removeprefix(f"{self.url}/")
            local.parent.mkdir(parents=True, exist_ok=True)
            local.write_text(read_text(name), encoding="utf-8")


def _is_results(path: Path) -> bool:
    """Whether a results file is ours, by its first line, or is not there; one cut short is ours."""
    if not os.path.lexists(path):
        return True
    if not path.is_file():
        return False
    with path.open("rb") as file:
        line = file.readline(len(FIRST_WORDS))
    return FIRST_WORDS.startswith(line)


def read_records(lines: Iterable[str]) -> Iterator[AttemptRecord]:
    """Yield the records of a results file; lines that were cut short are skipped."""
    known = {each.name for each in fields(AttemptRecord)}
    for line in lines:
        with suppress(ValueError, TypeError, AttributeError):
            content = json.loads(line)
            yield AttemptRecord(**{key: content[key] for key in known & content.keys()})

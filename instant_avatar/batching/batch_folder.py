"""The output folder of a batch, local or behind a URL: avatars, and the results of all captures.

Its summary.html is a contact sheet, the worst first.
"""

import json
import math
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import fields, replace
from pathlib import Path
from statistics import median
from typing import final
from urllib.parse import quote

from capture.atomic_files import (
    OutputFileList,
    atomic_folder,
    check_replaceable_folder,
    write_text_atomically,
)
from capture.input_error import InputError
from instant_avatar.batching.capture_discovery import BatchCapture
from instant_avatar.batching.ingest_attempt import (
    ANIMATION_NAME,
    LOG_NAME,
    PACKAGE_NAME,
    Attempt,
    AttemptRecord,
)
from instant_avatar.batching.remote_files import (
    RemoteFileError,
    is_url,
    list_files,
    open_remote,
    read_text,
)
from instant_avatar.cli.console import Console, format_duration
from instant_avatar.report.page_rendering import render_template
from instant_avatar.report.report_schema import format_psnr
from instant_avatar.run.run_folder import claim_folder

RESULTS_NAME = "results.jsonl"
"""A line for each capture that has ended, the newest last."""
FAILED_NAME = "_failed"
"""Folder with the logs of captures without an avatar."""
STATUSES = ("failed", "refused", "waiting", "done")
"""States of a capture, the worst first."""
Results = Mapping[str, AttemptRecord | None]
"""The result of each capture by its name; None for one that waits."""


def folder_of(name: str, status: str) -> str:
    """Return the folder of a capture's files, relative to --out."""
    return name if status == "done" else f"{FAILED_NAME}/{name}"


@final
class BatchFolder:
    """The output folder of a batch, a path or URL; `records` are in the order of their ends."""

    def __init__(self, place: str) -> None:
        """Name the folder; `claim` creates it."""
        self.place = place.rstrip("/")
        self.path = None if is_url(place) else Path(place)
        self.records: list[AttemptRecord] = []
        self._latest: dict[str, AttemptRecord] = {}
        self._packages: frozenset[str] = frozenset()
        self._saved_at = 0.0

    @contextmanager
    def claim(self, console: Console) -> Iterator[None]:
        """Create the folder, lock it if it is local, and read the results, during a block."""
        with ExitStack() as held:
            if self.path is not None:
                marker = OutputFileList(self.path)
                if self.path.exists() and any(self.path.iterdir()) and not marker.exists():
                    raise InputError(
                        f"{self.path} holds files that ia-batch did not write. Name a folder that "
                        "is empty or new (--out)."
                    )
                held.enter_context(claim_folder(self.path, console))
                marker.create()
                held.callback(marker.remove_if_empty)
            self._read()
            try:
                yield
            finally:
                if self.path is None:
                    self._save()

    def settled(self, capture: BatchCapture, *, again: bool) -> AttemptRecord | None:
        """Return the result that stands for a capture; None if it is to be learnt.

        With `again` it is learnt if it was refused or has failed before.
        """
        latest = self._latest.get(capture.name)
        if latest is not None and latest.key == (capture.input_key, capture.options_key):
            is_there = capture.name in self._packages
            if is_there if latest.status == "done" else not again:
                return latest
        if self.path is not None:
            check_replaceable_folder(self.path / capture.name)
            check_replaceable_folder(self.path / FAILED_NAME / capture.name)
        return None

    def place_attempt(self, attempt: Attempt) -> AttemptRecord:
        """Write the files of an attempt, then its line in the results, which is returned."""
        record, name = attempt.record, attempt.record.capture
        folder = folder_of(name, record.status)
        if self.path is not None:
            with atomic_folder(self.path / folder) as part:
                for file, content in attempt.files.items():
                    (part / file).parent.mkdir(parents=True, exist_ok=True)
                    (part / file).write_bytes(content)
            if record.status == "done":
                OutputFileList(self.path / FAILED_NAME / name).remove_all()
        else:
            for file in sorted(attempt.files, key=PACKAGE_NAME.__eq__):  # the package is the last
                self._send(f"{folder}/{file}", attempt.files[file])
        latest = self._latest.get(name)
        if latest is not None and latest.key == record.key:
            record = replace(record, attempt=latest.attempt + 1)
        self.records.append(record)
        self._latest[name] = record
        if self.path is not None:
            with (self.path / RESULTS_NAME).open("a", encoding="utf-8") as results:
                results.write(_line(record))
        elif time.monotonic() - self._saved_at > 30.0:  # nothing is appended at a URL
            with suppress(RemoteFileError):  # the next time sends it
                self._save()
        return record

    def write_text(self, name: str, text: str) -> None:
        """Write a text file into the folder, whole or not at all."""
        if self.path is None:
            self._send(name, text.encode())
        else:
            write_text_atomically(self.path / name, text, replace=True)

    def _read(self) -> None:
        results = f"{self.place}/{RESULTS_NAME}"
        if not list_files(results):
            return
        text = read_text(results)
        self.records = list(_read_records(text))
        self._latest = {record.capture: record for record in self.records}
        if text.strip() and not self.records:
            raise InputError(
                f"{results} is not what ia-batch wrote, so it is not replaced. Move it elsewhere, "
                "or name another folder (--out)."
            )
        packages = (path for path in list_files(self.place) if path.endswith(f"/{PACKAGE_NAME}"))
        self._packages = frozenset(path.split("/")[-2] for path in packages)
        if not text.endswith("\n"):  # its last line was cut short
            self._save()

    def _save(self) -> None:
        self._saved_at = time.monotonic()
        self.write_text(RESULTS_NAME, "".join(map(_line, self.records)))

    def _send(self, name: str, content: bytes) -> None:
        with open_remote(f"{self.place}/{name}") as (system, path):
            system.makedirs(path.rsplit("/", 1)[0], exist_ok=True)
            system.pipe_file(path, content)


def _line(record: AttemptRecord) -> str:
    return json.dumps(vars(record), allow_nan=False) + "\n"


def _read_records(text: str) -> Iterator[AttemptRecord]:
    """Yield the records of a results file; lines that were cut short are skipped."""
    known = {each.name for each in fields(AttemptRecord)}
    for line in text.splitlines():
        with suppress(ValueError, TypeError, AttributeError):
            content = json.loads(line)
            yield AttemptRecord(**{key: content[key] for key in known & content.keys()})


def describe_result(record: AttemptRecord | None) -> str:
    """Return quality and duration of an avatar, or why there is none."""
    if record is None:
        return "not learnt yet"
    if record.status != "done":
        return f"{record.status}: {record.cause}"
    score = format_psnr(record.figures.get("psnr"), record.figures.get("verdict"))
    return f"{score}, {format_duration(record.wall_s)}"


def headline(results: Results) -> str:
    """Return counts, median quality and median time in a sentence."""
    counts = Counter(map(_status, results.values()))
    text = ", ".join(f"{counts[s]} {s}" for s in reversed(STATUSES) if counts[s])
    done = [record for record in results.values() if record is not None and record.status == "done"]
    scores = [psnr for record in done if (psnr := record.figures.get("psnr")) is not None]
    if scores:
        wall_s = median(record.wall_s for record in done)
        text += f". Median {format_psnr(median(scores), None)}, {format_duration(wall_s)}"
    return f"{text}."


def summary_page(results: Results, title: str) -> str:
    """Return the page; its pictures lie beside it, in the folders of the captures."""
    cards = [
        (name, _status(record), quote(folder_of(name, _status(record))), describe_result(record))
        for name, record in sorted(results.items(), key=_badness)
    ]
    return render_template(
        "summary.html",
        title=title,
        headline=headline(results),
        cards=cards,
        animation=ANIMATION_NAME,
        log=LOG_NAME,
    )


def _status(record: AttemptRecord | None) -> str:
    return "waiting" if record is None else record.status


def _badness(item: tuple[str, AttemptRecord | None]) -> tuple[int, float, str]:
    """Return a key by which the worst come first: no avatar, then the lowest PSNR."""
    name, record = item
    psnr = None if record is None else record.figures.get("psnr")
    return STATUSES.index(_status(record)), -math.inf if psnr is None else psnr, name

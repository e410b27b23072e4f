"""Where a run lies on disk, which of its files are ours, and whether there is one already."""

import difflib
import json
import os
import shlex
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from apps.cli.console import Console
from apps.cli.output_paths import check_disjoint_from_inputs, check_writable, unused_path
from apps.run.run_lock import LOCK_FILE_NAME as LOCK
from apps.run.run_lock import lock_folder
from capture.input_error import InputError
from capture.output_file_list import OutputFileList

STATE_FILE = "state.pt"
CHECKPOINT_FILES = (STATE_FILE, "person.npz", "frames.tensors", "earlier.tensors")
"""What ia-ingest writes into checkpoint/."""


@dataclass(frozen=True, kw_only=True)
class RunFolder:
    """A folder that holds one run of ia-ingest.

    Other files may lie in it; those that a run would have to replace must be its own.

    Attributes:
        path: The folder.
    """

    path: Path

    @property
    def package(self) -> Path:
        """The avatar."""
        return self.path / "avatar.iavatar"

    @property
    def report_json(self) -> Path:
        """What was done and how well, as JSON."""
        return self.path / "report.json"

    @property
    def report_html(self) -> Path:
        """The same to look at."""
        return self.path / "report.html"

    @property
    def checkpoint(self) -> Path:
        """The folder from which training can go on."""
        return self.path / "checkpoint"

    @property
    def body_file(self) -> Path:
        """The body that the avatar has, for videos that are added later."""
        return self.checkpoint / "person.npz"

    @property
    def cameras(self) -> Path:
        """Cameras that were solved here; the folder of the same name without ending made them."""
        return self.path / "cameras.npz"

    @property
    def poses(self) -> Path:
        """The poses in the world of the solved cameras."""
        return self.path / "poses.npz"

    @property
    def files(self) -> tuple[Path, ...]:
        """All that a run may write, except for the stages of solved cameras."""
        top = (self.package, self.report_json, self.report_html, self.cameras, self.poses)
        return (*top, *(self.checkpoint / name for name in CHECKPOINT_FILES))

    def has_run(self) -> bool:
        """Whether any part of a run is there."""
        return any(path.exists() for path in self.files)

    def has_checkpoint(self) -> bool:
        """Whether training can go on from here."""
        return (self.checkpoint / STATE_FILE).is_file()

    def check_usable(self, inputs: Iterable[Path], *, resume: bool, overwrite: bool) -> None:
        """Whether the folder is a place for a run; nothing is made yet.

        Args:
            inputs: What the run reads.
            resume: Whether it goes on with a run that is there.
            overwrite: Whether it replaces one.

        Raises:
            InputError: If the path is no folder, has to do with an input, holds files that are not
                ours where a run's would go, or cannot be written to.
        """
        if resume and overwrite:
            raise InputError(
                "--resume goes on with a run, --overwrite removes it: give one of them."
            )
        if self.path.exists() and not self.path.is_dir():
            raise InputError(f"{self.path} is a file; --out names the folder that holds the run.")
        check_disjoint_from_inputs(self.path, "--out", inputs)
        stranger = self._foreign_file()
        if stranger is not None:
            free = shlex.quote(str(unused_path(self.path)))
            raise InputError(
                f"{stranger} is not what ia-ingest wrote there, and a run in {self.path} would "
                f"have to replace it. Move it elsewhere, or name another folder: --out {free}"
            )
        if resume and not (self.has_checkpoint() or self._was_started()):
            raise InputError(self._nothing_to_resume_message())
        check_writable(self.path, "--out")

    @contextmanager
    def claim(self, console: Console, *, resume: bool, overwrite: bool) -> Iterator[None]:
        """Makes the folder and keeps other runs out of it; if it stays empty, it goes again.

        Args:
            console: Where warnings are shown.
            resume: Whether a run goes on with what is there.
            overwrite: Whether it replaces what is there.

        Raises:
            InputError: If there is a run that would be lost.
            Stop: If another run is writing there.
        """
        made = [p for p in (self.path, *self.path.parents) if not p.exists()]
        self.path.mkdir(parents=True, exist_ok=True)
        try:
            with lock_folder(self.path, console):
                if self.has_run() and not (resume or overwrite):
                    raise InputError(
                        f"{self.path} already holds a run. Go on with it (--resume), replace it "
                        "(--overwrite), or name another folder (--out)."
                    )
                try:
                    yield
                finally:
                    self.remove_empty_folders()
        finally:
            for folder in made:
                with suppress(OSError):  # it is not empty
                    folder.rmdir()

    def start_run(self, *, resume: bool) -> None:
        """Starts the lists of what is ours; unless the run is resumed, an older one is removed.

        Call it when nothing can be wrong with the input any more.

        Raises:
            InputError: If files came meanwhile that are not ours.
        """
        older = self._unlisted_run_files()
        self.checkpoint.mkdir(parents=True, exist_ok=True)
        for folder in (self.path, self.checkpoint):
            listing = OutputFileList(folder)
            listing.create()
            listing.add_all({path.name: path for path in older if path.parent == folder})
            listing.remove_temporaries()
        for path in () if resume else self.files:
            self.remove(path)

    def remove(self, path: Path) -> None:
        """Removes one of the run's files.

        Raises:
            InputError: If a file is there that is not ours.
        """
        if not OutputFileList(path.parent).remove(path.name):
            raise InputError(f"{path} is not what ia-ingest wrote there; it was left alone.")

    def describe_remaining_files(self) -> str:
        """What is there after a run has failed half-way, and what a user can do."""
        files = (self.package, self.report_json, self.report_html, self.cameras, self.poses)
        names = [path.name for path in files if path.exists()]
        there = f"{self.path} holds {', '.join(names)}." if names else ""
        if not self.has_checkpoint() and self.package.exists():
            return f"{there} Without a checkpoint the avatar can be played, but not learnt on."
        if not self.has_checkpoint():
            return there or f"Nothing was written to {self.path}."
        return (
            f"{there} The newest checkpoint is kept in {self.checkpoint}: run the same command "
            "with --resume, in place of any --overwrite, to go on from it."
        ).lstrip()

    def release(self) -> None:
        """Gives up a folder that this process has claimed, where the process ends at once."""
        (self.path / LOCK).unlink(missing_ok=True)
        self.remove_empty_folders()

    def remove_empty_folders(self) -> None:
        """Removes folders that nothing was written to."""
        for folder in (self.checkpoint, self.path):
            OutputFileList(folder).remove_if_empty()
            with suppress(OSError):  # it is not empty, or not there
                folder.rmdir()

    def _was_started(self) -> bool:
        """Whether a run was here that was killed, perhaps before it had written anything."""
        return OutputFileList(self.path).exists() or (self.path / LOCK).is_file()

    def _foreign_file(self) -> Path | None:
        """A file that is not ours where a run's would go."""
        older = self._unlisted_run_files()
        for path in self.files:
            there = os.path.lexists(path)
            if there and path not in older and not OutputFileList(path.parent).owns(path.name):
                return path
        for folder in (self.checkpoint, self.path / "cameras"):
            if os.path.lexists(folder) and not folder.is_dir():
                return folder
        lists = (OutputFileList(self.path), OutputFileList(self.checkpoint))
        return next((listing.path for listing in lists if listing.path_is_foreign()), None)

    def _unlisted_run_files(self) -> list[Path]:
        """The files of a run that was made before there were lists, known by its report."""
        if OutputFileList(self.path).exists() or not is_run_report(self.report_json):
            return []
        solved = json.loads(self.report_json.read_text(encoding="utf-8")).get("cameras") or {}
        ours = set(self.files)
        if solved.get("verdict") != "solved":
            ours -= {self.cameras, self.poses}
        return [path for path in self.files if path in ours and path.is_file()]

    def _nothing_to_resume_message(self) -> str:
        """That there is no run to go on with, and which one may have been meant."""
        beside = self.path.absolute().parent
        runs = [p.parent.parent.name for p in sorted(beside.glob(f"*/checkpoint/{STATE_FILE}"))]
        near = difflib.get_close_matches(self.path.absolute().name, runs, n=1, cutoff=0.5)
        meant = [shlex.quote(str(self.path.with_name(name))) for name in near]
        return (
            f"There is no run in {self.path}, so there is nothing to --resume."
            + "".join(f" Did you mean --out {path}?" for path in meant)
            + " To begin a new run, leave --resume out."
        )


def is_run_report(path: Path) -> bool:
    """Whether a file is a report.json that ia-ingest wrote."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    keys = {"format", "command", "recipe", "machine", "training", "held_out"}
    return isinstance(content, dict) and keys <= content.keys()

"""Folder of a run: its files, which of them ia-ingest wrote, and the lock of its process."""

import errno
import json
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from filelock import BaseFileLock, FileLock, Timeout

from capture.atomic_files import RESERVED_PREFIX, OutputFileList
from capture.input_error import InputError, quote_command
from instant_avatar.cli.command_line import RESOURCE_UNAVAILABLE, CommandExit
from instant_avatar.cli.console import Console
from instant_avatar.cli.shared_options import (
    check_disjoint_from_inputs,
    check_writable,
    unused_path,
)

LOCK_FILE_NAME = f"{RESERVED_PREFIX}lock"
"""Name of the locked file in a folder."""


@contextmanager
def claim_folder(folder: Path, console: Console) -> Iterator[None]:
    """Create and lock a folder during a block; remove the folders it made if they stayed empty.

    After `kill -9` the lock file remains, but not the lock. File systems without locks cause a
    warning; a lock of another process ends the command (`CommandExit`).
    """
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK_FILE_NAME, timeout=0.0)
    try:
        _acquire(lock, folder, console)
        yield
    finally:
        if lock.is_locked:
            with suppress(OSError):  # Windows, where releasing it removes it
                Path(lock.lock_file).unlink()
            lock.release()
        for each in made:
            with suppress(OSError):  # not empty
                each.rmdir()


def _acquire(lock: BaseFileLock, folder: Path, console: Console) -> None:
    try:
        lock.acquire()
    except Timeout:
        raise CommandExit(
            f"Another command is writing into {folder}. Wait until it ends, or choose another "
            "folder (--out).",
            RESOURCE_UNAVAILABLE,
        ) from None
    except OSError as error:
        if error.errno not in {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP}:
            raise
        console.warning(
            f"The file system of {folder} has no locks ({error.strerror}): make sure that no other "
            "command writes into this folder at the same time."
        )


@contextmanager
def listing_outputs(folder: Path) -> Iterator[None]:
    """Make a folder whose files are listed as ours during a block; remove it if it stayed empty."""
    folder.mkdir(parents=True, exist_ok=True)
    OutputFileList(folder).create()
    OutputFileList(folder).remove_temporaries()
    try:
        yield
    finally:
        remove_if_empty(folder)


def remove_if_empty(folder: Path) -> None:
    """Remove a folder of ours that nothing was written to."""
    OutputFileList(folder).remove_if_empty()
    with suppress(OSError):  # not empty, or missing
        folder.rmdir()


STATE_FILE = "state.pt"
"""Trainer and avatar, in checkpoint/."""
CHECKPOINT_FILES = (STATE_FILE, "person.npz", "fit.npz", "frames.tensors", "earlier.tensors")
"""Files that ia-ingest writes into checkpoint/."""


class _Inside:
    """A path in a run's folder."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, run: "RunFolder", owner: type | None = None) -> Path:
        """Return the path; it need not exist."""
        return run.path / self._name


@dataclass(frozen=True, kw_only=True)
class RunFolder:
    """A folder that holds one run of ia-ingest; files that the user puts there stay."""

    path: Path

    package = _Inside("avatar.iavatar")
    """The package with the avatar."""
    report_json = _Inside("report.json")
    """The report for machines."""
    report_html = _Inside("report.html")
    """The report as a page."""
    animation = _Inside("turning.webp")
    """The avatar in novel poses, as the report shows it."""
    checkpoint = _Inside("checkpoint")
    """The folder from which training can continue."""
    body_file = _Inside("checkpoint/person.npz")
    """The body of the avatar, for videos that are added later."""
    fit_file = _Inside("checkpoint/fit.npz")
    """Body, poses and focal length fitted to the masks of the last video."""
    cameras = _Inside("cameras.npz")
    """Solved cameras."""
    poses = _Inside("poses.npz")
    """Poses in the world of the solved cameras."""
    tracking = _Inside("tracking")
    """Folder of the poses and masks that were tracked in the video, if none were given."""
    tracked_poses = _Inside("tracking/poses.npz")
    """The poses that were tracked in the video."""
    tracked_video = _Inside("tracking/skeleton.mp4")
    """The video with the poses drawn over it, of poses that were refused."""
    tracking_grade = _Inside("tracking/grade.json")
    """Grades of the tracked poses, and what they were tracked for."""

    @property
    def files(self) -> tuple[Path, ...]:
        """All files that a run may write."""
        top = (self.package, self.report_json, self.report_html, self.animation)
        top += (self.cameras, self.poses)
        return (*top, *(self.checkpoint / name for name in CHECKPOINT_FILES))

    def has_checkpoint(self) -> bool:
        """True if training can continue from here."""
        return (self.checkpoint / STATE_FILE).is_file()

    def check_usable(self, inputs: Iterable[Path], *, resume: bool, overwrite: bool) -> None:
        """Refuse a folder to which no run can be written; nothing is created yet."""
        if resume and overwrite:
            raise InputError("--resume and --overwrite are mutually exclusive.")
        if self.path.exists() and not self.path.is_dir():
            raise InputError(f"{self.path} is a file; --out names the folder that holds the run.")
        check_disjoint_from_inputs(self.path, "--out", inputs)
        marker, free = OutputFileList(self.path), quote_command(unused_path(self.path))
        if marker.owns("grade.json"):
            raise InputError(
                f"{self.path} holds poses that ia-track wrote. Choose another folder: --out {free}"
            )
        foreign = self._foreign_file()
        if foreign is not None:
            raise InputError(
                f"{foreign} was not written by ia-ingest. Move it, or choose an empty or new "
                f"folder: --out {free}"
            )
        if resume and not marker.exists():
            raise InputError(
                f"No run to --resume in {self.path}. To start a new run, omit --resume."
            )
        check_writable(self.path, "--out")

    @contextmanager
    def claim(self, console: Console, *, resume: bool, overwrite: bool) -> Iterator[None]:
        """Create, lock and mark the folder during a block; remove it if it stayed empty."""
        with claim_folder(self.path, console):
            if any(path.exists() for path in self.files) and not (resume or overwrite):
                raise InputError(
                    f"{self.path} already holds a run. Continue it (--resume), replace it "
                    "(--overwrite), or choose another folder (--out)."
                )
            OutputFileList(self.path).create()
            try:
                yield
            finally:
                self.remove_empty_folders()

    def start_run(self, *, resume: bool) -> None:
        """Mark the folders as ours; remove an older run unless it is resumed.

        Call it once the inputs have been found good.
        """
        self.checkpoint.mkdir(parents=True, exist_ok=True)
        for folder in (self.path, self.checkpoint):
            OutputFileList(folder).create()
            OutputFileList(folder).remove_temporaries()
        for path in () if resume else self.files:
            self.remove(path)

    def remove(self, path: Path) -> None:
        """Remove one of the run's files; an `InputError` keeps those of other programs."""
        if not OutputFileList(path.parent).remove(path.name):
            raise InputError(f"{path} was not written by ia-ingest; it was kept.")

    def describe_remaining_files(self) -> str:
        """Tell what an interrupted run has left, and how to continue."""
        files = (self.package, self.report_json, self.report_html, self.cameras, self.poses)
        names = [path.name for path in files if path.exists()]
        held = f"{self.path} holds {', '.join(names)}." if names else ""
        if not self.has_checkpoint() and self.package.exists():
            return f"{held} Without a checkpoint the avatar can be played but not trained further."
        if not self.has_checkpoint():
            return held or f"Nothing was written to {self.path}."
        return (
            f"{held} The newest checkpoint is kept in {self.checkpoint}: to continue from it, run "
            "the same command with --resume instead of --overwrite."
        ).lstrip()

    def release(self) -> None:
        """Release a claimed folder where the process is about to exit without unwinding."""
        (self.path / LOCK_FILE_NAME).unlink(missing_ok=True)
        self.remove_empty_folders()

    def remove_empty_folders(self) -> None:
        """Remove folders that nothing was written to."""
        for folder in (self.checkpoint, self.path):
            remove_if_empty(folder)

    def _foreign_file(self) -> Path | None:
        """Return a foreign file that forbids a run here; None if there is none."""
        if not OutputFileList(self.path).exists():
            files = sorted(self.path.iterdir()) if self.path.exists() else []
            return next((f for f in files if not f.name.startswith(RESERVED_PREFIX)), None)
        for path in (*self.files, self.tracked_poses, self.tracking_grade, self.tracked_video):
            if os.path.lexists(path) and not OutputFileList(path.parent).owns(path.name):
                return path
        folders = (self.checkpoint, self.tracking)
        return next((f for f in folders if os.path.lexists(f) and not f.is_dir()), None)


def is_run_report(path: Path) -> bool:
    """True if a file is a report.json of ia-ingest."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    keys = {"format", "command", "recipe", "machine", "training", "held_out"}
    return isinstance(content, dict) and keys <= content.keys()

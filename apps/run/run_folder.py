"""Folder of a run: its files, which of them ia-ingest wrote, and the lock of its process."""

import difflib
import errno
import json
import os
import re
import shlex
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from apps.cli.command_line import RESOURCE_UNAVAILABLE, CommandExit
from apps.cli.console import Console
from apps.cli.shared_options import check_disjoint_from_inputs, check_writable, unused_path
from capture.atomic_files import RESERVED_PREFIX, OutputFileList
from capture.input_error import InputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

LOCK_FILE_NAME = f"{RESERVED_PREFIX}lock"
"""Name of the locked file in the folder."""
LOCK_LABEL_PATTERN = re.compile(r"instant-avatar-stream run, process (\d+), since (.+)\n?")
"""Content of a lock file: process and time."""
LOCKED_ERRNOS = frozenset({errno.EWOULDBLOCK, errno.EACCES})
"""Errors of `flock` where another process holds the lock."""


@contextmanager
def claim_folder(folder: Path, console: Console, *, shared: bool = False) -> Iterator[None]:
    """Create and lock a folder during a block; remove the folders it made if they stayed empty.

    Args:
        folder: The folder.
        console: Shows warnings.
        shared: As of `lock_folder`.

    Raises:
        CommandExit, InputError: As `lock_folder`.
    """
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with lock_folder(folder, console, shared=shared):
            yield
    finally:
        for each in made:
            with suppress(OSError):  # not empty
                each.rmdir()


@contextmanager
def lock_folder(folder: Path, console: Console, *, shared: bool = False) -> Iterator[None]:
    """Lock a folder for this process; remove the lock file at the end.

    After `kill -9` the file remains, but not the lock. File systems without locks cause a warning.

    Args:
        folder: An existing folder.
        console: Shows warnings.
        shared: Whether others may share the lock; its file is then left for them.

    Raises:
        CommandExit: If another process holds the lock.
        InputError: If a foreign file has the lock's name.
    """
    path = folder / LOCK_FILE_NAME
    descriptor = _acquire(path, console, shared=shared)
    try:
        yield
    finally:
        if descriptor is not None:
            if not shared:
                path.unlink(missing_ok=True)
            os.close(descriptor)


def _acquire(path: Path, console: Console, *, shared: bool) -> int | None:
    """Return the locked file's descriptor; None where files cannot be locked."""
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            label = os.read(descriptor, 1000).decode(errors="replace")
            if label and LOCK_LABEL_PATTERN.fullmatch(label) is None:
                raise InputError(
                    f"{path} is not a lock of this program. Move it, or choose another folder "
                    "(--out)."
                )
            if not _try_lock(descriptor, path.parent, label, console, shared=shared):
                path.unlink(missing_ok=True)
                os.close(descriptor)
                return None
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(descriptor), path.stat()):
                    break  # else a run that just ended has removed it
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    text = f"instant-avatar-stream run, process {os.getpid()}, since {since}\n"
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, text.encode(), 0)
    return descriptor


def _try_lock(descriptor: int, folder: Path, label: str, console: Console, *, shared: bool) -> bool:
    """Lock a file; return False where the file system has no locks."""
    try:
        if fcntl is None:
            raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        return True
    except OSError as error:
        if error.errno in LOCKED_ERRNOS:
            raise CommandExit(_busy_message(folder, label), RESOURCE_UNAVAILABLE) from None
        console.warning(
            f"The file system of {folder} has no locks ({error.strerror}): make sure that no other "
            "command writes into this folder at the same time."
        )
        return False


def _busy_message(folder: Path, label: str) -> str:
    found = LOCK_LABEL_PATTERN.fullmatch(label)
    who = f" (process {found[1]}, since {found[2]})" if found else ""
    return (
        f"Another command is writing into {folder}{who}. Wait until it ends, or choose another "
        "folder (--out)."
    )


STATE_FILE = "state.pt"
"""Trainer and avatar, in checkpoint/."""
CHECKPOINT_FILES = (STATE_FILE, "person.npz", "fit.npz", "frames.tensors", "earlier.tensors")
"""Files that ia-ingest writes into checkpoint/."""


@dataclass(frozen=True, kw_only=True)
class RunFolder:
    """A folder that holds one run of ia-ingest.

    Files of the user may lie in it, but not where a run writes its own.

    Attributes:
        path: The folder.
    """

    path: Path

    @property
    def package(self) -> Path:
        """The package with the avatar."""
        return self.path / "avatar.iavatar"

    @property
    def report_json(self) -> Path:
        """The report for machines."""
        return self.path / "report.json"

    @property
    def report_html(self) -> Path:
        """The report as a page."""
        return self.path / "report.html"

    @property
    def animation(self) -> Path:
        """The avatar in novel poses, as the report shows it."""
        return self.path / "turning.webp"

    @property
    def checkpoint(self) -> Path:
        """The folder from which training can continue."""
        return self.path / "checkpoint"

    @property
    def body_file(self) -> Path:
        """The body of the avatar, for videos that are added later."""
        return self.checkpoint / "person.npz"

    @property
    def fit_file(self) -> Path:
        """What was fitted to the masks of the last video."""
        return self.checkpoint / "fit.npz"

    @property
    def cameras(self) -> Path:
        """Solved cameras; the folder cameras/ holds the stages of solving."""
        return self.path / "cameras.npz"

    @property
    def poses(self) -> Path:
        """Poses in the world of the solved cameras."""
        return self.path / "poses.npz"

    @property
    def tracking(self) -> Path:
        """Folder of the poses and masks that were tracked in the video, if none were given."""
        return self.path / "tracking"

    @property
    def tracked_poses(self) -> Path:
        """The poses that were tracked in the video."""
        return self.tracking / "poses.npz"

    @property
    def tracking_grade(self) -> Path:
        """Grades of the tracked poses, and what they were tracked for."""
        return self.tracking / "grade.json"

    @property
    def files(self) -> tuple[Path, ...]:
        """All files that a run may write, except for the stages of camera solving."""
        top = (self.package, self.report_json, self.report_html, self.animation)
        top += (self.cameras, self.poses)
        return (*top, *(self.checkpoint / name for name in CHECKPOINT_FILES))

    def has_run(self) -> bool:
        """Whether any file of a run exists."""
        return any(path.exists() for path in self.files)

    def has_checkpoint(self) -> bool:
        """Whether training can continue from here."""
        return (self.checkpoint / STATE_FILE).is_file()

    def check_usable(self, inputs: Iterable[Path], *, resume: bool, overwrite: bool) -> None:
        """Check that a run can be written here; nothing is created yet.

        Args:
            inputs: Files and folders that the run reads.
            resume: Whether to continue an existing run.
            overwrite: Whether to replace an existing run.

        Raises:
            InputError: If the path is a file, overlaps an input, holds foreign files where a run
                writes, or cannot be written to.
        """
        if resume and overwrite:
            raise InputError("--resume and --overwrite are mutually exclusive.")
        if self.path.exists() and not self.path.is_dir():
            raise InputError(f"{self.path} is a file; --out names the folder that holds the run.")
        check_disjoint_from_inputs(self.path, "--out", inputs)
        if OutputFileList(self.path).owns("grade.json"):
            free = shlex.quote(str(unused_path(self.path)))
            raise InputError(
                f"{self.path} holds poses that ia-track wrote. Choose another folder: --out {free}"
            )
        foreign = self._foreign_file()
        if foreign is not None:
            free = shlex.quote(str(unused_path(self.path)))
            raise InputError(
                f"{foreign} was not written by ia-ingest and would be overwritten. Move it, or "
                f"choose another folder: --out {free}"
            )
        if resume and not (self.has_checkpoint() or self._was_started()):
            raise InputError(self._nothing_to_resume_message())
        check_writable(self.path, "--out")

    @contextmanager
    def claim(self, console: Console, *, resume: bool, overwrite: bool) -> Iterator[None]:
        """Create and lock the folder during a block; remove it afterwards if it stayed empty.

        Args:
            console: Shows warnings.
            resume: Whether to continue an existing run.
            overwrite: Whether to replace an existing run.

        Raises:
            InputError: If a run exists and neither flag is given.
            CommandExit: If another run is writing here.
        """
        with claim_folder(self.path, console):
            if self.has_run() and not (resume or overwrite):
                raise InputError(
                    f"{self.path} already holds a run. Continue it (--resume), replace it "
                    "(--overwrite), or choose another folder (--out)."
                )
            try:
                yield
            finally:
                self.remove_empty_folders()

    def start_run(self, *, resume: bool) -> None:
        """Start the lists of written files; remove an older run unless it is resumed.

        Call it once the inputs have been found good.

        Raises:
            InputError: If foreign files have appeared since `check_usable`.
        """
        self.checkpoint.mkdir(parents=True, exist_ok=True)
        for folder in (self.path, self.checkpoint):
            listing = OutputFileList(folder)
            listing.create()
            listing.remove_temporaries()
        for path in () if resume else self.files:
            self.remove(path)

    def remove(self, path: Path) -> None:
        """Remove one of the run's files.

        Raises:
            InputError: If ia-ingest did not write the file.
        """
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
            OutputFileList(folder).remove_if_empty()
            with suppress(OSError):  # not empty, or missing
                folder.rmdir()

    def _was_started(self) -> bool:
        """Whether a run was started here, even if it was killed before it wrote a file."""
        lists = (OutputFileList(self.path), OutputFileList(self.tracking))
        return any(each.exists() for each in lists) or (self.path / LOCK_FILE_NAME).is_file()

    def _foreign_file(self) -> Path | None:
        """Return a foreign file where a run would write; None if there is none."""
        for path in (*self.files, self.tracked_poses, self.tracking_grade):
            if os.path.lexists(path) and not OutputFileList(path.parent).owns(path.name):
                return path
        for folder in (self.checkpoint, self.path / "cameras", self.tracking):
            if os.path.lexists(folder) and not folder.is_dir():
                return folder
        lists = (OutputFileList(self.path), OutputFileList(self.checkpoint))
        return next((listing.path for listing in lists if listing.path_is_foreign()), None)

    def _nothing_to_resume_message(self) -> str:
        """Tell that there is no run to resume, and suggest the one probably meant."""
        beside = self.path.absolute().parent
        runs = [p.parent.parent.name for p in sorted(beside.glob(f"*/checkpoint/{STATE_FILE}"))]
        near = difflib.get_close_matches(self.path.absolute().name, runs, n=1, cutoff=0.5)
        meant = [shlex.quote(str(self.path.with_name(name))) for name in near]
        return (
            f"No run to --resume in {self.path}."
            + "".join(f" Did you mean --out {path}?" for path in meant)
            + " To start a new run, omit --resume."
        )


def is_run_report(path: Path) -> bool:
    """Whether a file is a report.json of ia-ingest."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    keys = {"format", "command", "recipe", "machine", "training", "held_out"}
    return isinstance(content, dict) and keys <= content.keys()

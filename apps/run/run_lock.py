"""Lock of an output folder, which the kernel releases however the process ends."""

import errno
import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from apps.cli.console import Console
from apps.cli.exit_codes import RESOURCE_UNAVAILABLE, CommandExit
from capture.atomic_files import RESERVED_PREFIX
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

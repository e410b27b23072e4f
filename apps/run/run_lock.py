"""One run at a time: a lock on a run's folder, which the kernel releases however a run ends."""

import errno
import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from apps.cli.console import Console
from apps.cli.exit_codes import RESOURCE_UNAVAILABLE, CommandExit
from capture.input_error import InputError
from capture.output_file_list import RESERVED_PREFIX

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

LOCK_FILE_NAME = f"{RESERVED_PREFIX}lock"
LOCK_LABEL_PATTERN = re.compile(r"instant-avatar-stream run, process (\d+), since (.+)\n?")
LOCKED_ERRNOS = frozenset({errno.EWOULDBLOCK, errno.EACCES})


@contextmanager
def lock_folder(folder: Path, console: Console) -> Iterator[None]:
    """Holds a folder for this process; the file that is locked is removed at the end.

    After `kill -9` the file stays, but not the lock. On file systems without locks a warning is
    shown instead.

    Args:
        folder: Is there already.
        console: Where warnings are shown.

    Raises:
        Stop: If another process holds it.
        InputError: If a file of somebody else has the lock's name.
    """
    path = folder / LOCK_FILE_NAME
    descriptor = _acquire(path, console)
    try:
        yield
    finally:
        if descriptor is not None:
            path.unlink(missing_ok=True)
            os.close(descriptor)


def _acquire(path: Path, console: Console) -> int | None:
    """The locked file; None where files cannot be locked."""
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            label = os.read(descriptor, 1000).decode(errors="replace")
            if label and LOCK_LABEL_PATTERN.fullmatch(label) is None:
                raise InputError(
                    f"{path} is not a lock that ia-ingest made. Move it elsewhere, or name another "
                    "folder (--out)."
                )
            if not _try_lock(descriptor, path.parent, label, console):
                path.unlink(missing_ok=True)
                os.close(descriptor)
                return None
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(descriptor), path.stat()):
                    break  # else it was removed by a run that ended just now
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    text = f"instant-avatar-stream run, process {os.getpid()}, since {since}\n"
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, text.encode(), 0)
    return descriptor


def _try_lock(descriptor: int, folder: Path, label: str, console: Console) -> bool:
    """Whether the file could be locked; False where there are no locks."""
    try:
        if fcntl is None:
            raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return True
    except OSError as error:
        if error.errno in LOCKED_ERRNOS:
            raise CommandExit(_busy_message(folder, label), RESOURCE_UNAVAILABLE) from None
        console.warning(
            f"The file system of {folder} has no locks ({error.strerror}): make sure that no other "
            "ia-ingest writes into this folder meanwhile."
        )
        return False


def _busy_message(folder: Path, label: str) -> str:
    found = LOCK_LABEL_PATTERN.fullmatch(label)
    who = f" (process {found[1]}, since {found[2]})" if found else ""
    return (
        f"Another ia-ingest is writing into {folder}{who}. Wait until it has ended, or name "
        "another folder (--out)."
    )

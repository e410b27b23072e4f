"""Files that appear whole or not at all."""

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from capture.errors import BadInput


def check_place(path: Path, flag: str) -> None:
    """Whether something can be written there, asked before any work is done for it.

    Args:
        path: A file or a folder; it and folders above it need not be there yet.
        flag: Which argument named it.

    Raises:
        BadInput: If that cannot be.
    """
    place = Path(os.path.abspath(path))
    while not place.exists() and place != place.parent:
        place = place.parent
    if place.is_file() and place.absolute() != Path(os.path.abspath(path)):
        raise BadInput(f"{flag} is {path}, but {place} is a file and holds nothing.")
    folder = place.parent if place.is_file() else place  # a file is replaced, not written into
    if not os.access(folder, os.W_OK):
        raise BadInput(f"{flag} is {path}, but {folder} cannot be written to. Name another place.")


def check_file_place(path: Path, flag: str) -> None:
    """The same for what shall be a file.

    Raises:
        BadInput: If that cannot be.
    """
    if path.is_dir():
        raise BadInput(f"{flag} is {path}, which is a folder; the name of a file was expected.")
    if not _is_stream(path):
        check_place(path, flag)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Gives a name to write to; the file takes its own name once the block is done.

    A link is followed: what it points to is replaced.

    The passing name keeps the suffix, by which encoders know what to write. An older file stays
    until then, and stays if the block fails.

    Raises:
        BadInput: If `path` is a folder, or a device or a pipe.
        OSError: If it cannot be written.
    """
    if path.is_dir():
        raise BadInput(f"{path} is a folder; the name of a file was expected.")
    if _is_stream(path):
        raise BadInput(f"{path} is a device or a pipe; the name of a file was expected.")
    path = Path(os.path.realpath(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        yield part
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Gives a folder to fill; it takes its own name, and an older one's place, at the end.

    A link is followed, as by `whole_file`.
    """
    path = Path(os.path.realpath(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    old = path.with_name(f".{path.name}.{os.getpid()}.old")
    part.mkdir()
    try:
        yield part
        if path.exists():
            path.rename(old)
        try:
            part.rename(path)
        except BaseException:
            if old.exists():
                old.rename(path)
            raise
    finally:
        shutil.rmtree(part, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """A text file, whole or not at all; a device such as /dev/stdout just gets the text."""
    if _is_stream(path):
        path.write_text(text, encoding="utf-8")
        return
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")


STDOUT = re.compile(r"/dev/(stdout|stderr|fd/\d+)|/proc/.*")


def _is_stream(path: Path) -> bool:
    """Whether a name is that of a device or a pipe; stdout is one wherever it was sent to."""
    named = STDOUT.fullmatch(str(path.absolute())) is not None
    return named or (path.exists() and not (path.is_file() or path.is_dir()))

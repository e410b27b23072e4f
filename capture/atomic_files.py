"""Write files and folders whole or not at all, and never over a file of another program."""

import os
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import final

from capture.input_error import InputError
from capture.output_file_list import OutputFileList


@final
class AtomicFile:
    """A file under a random name beside its own, which it takes when it is finished.

    The target of a link is replaced. The temporary name keeps the suffix, by which encoders choose
    a format. An older file stays until `commit`. In a folder with an `OutputFileList` the file is
    listed.

    Attributes:
        temporary_path: Where to write until `commit`.
    """

    def __init__(self, path: Path, *, replace: bool | None = None) -> None:
        """Makes the empty file, and folders above it.

        Args:
            path: The name that the file will have.
            replace: Whether a file that is there and is not known as ours may be replaced; None:
                only where no list says which files are ours.

        Raises:
            InputError: If `path` is a folder, a device or a pipe, or a file that must stay.
            OSError: If it cannot be written.
        """
        self._path, self._replace, self._finished = path, replace, False
        self._list = OutputFileList(path.parent)
        if path.is_dir():
            raise InputError(f"{path} is a folder; the name of a file was expected.")
        if is_stream(path):
            raise InputError(f"{path} is a device or a pipe; the name of a file was expected.")
        self._check_replaceable()
        real = Path(os.path.realpath(path))
        real.parent.mkdir(parents=True, exist_ok=True)
        self._real_path, self.temporary_path = (
            real,
            real.with_name(_temporary_name(path.stem, "part") + path.suffix),
        )
        if self._list.exists() and real.parent == Path(os.path.realpath(path.parent)):
            self._list.add_temporary(self.temporary_path.name)
        os.close(os.open(self.temporary_path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))

    def commit(self) -> None:
        """Flushes the file to the disk and gives it its name.

        Raises:
            InputError: If a file that must stay has come there meanwhile.
            OSError: If the disk is full.
        """
        with self.temporary_path.open("rb") as file:
            os.fsync(file.fileno())
        self._check_replaceable()
        if self._list.exists():
            self._list.add(self._path.name, self.temporary_path)
        self.temporary_path.replace(self._real_path)
        self._finished = True

    def discard(self) -> None:
        """Removes what was not finished."""
        if not self._finished:
            self.temporary_path.unlink(missing_ok=True)

    def _check_replaceable(self) -> None:
        if not is_replaceable(self._path, self._replace):
            raise InputError(
                f"{self._path} is there already, and is not what this program wrote there; it was "
                "left alone. Move it elsewhere, or name another place."
            )


def is_replaceable(path: Path, replace: bool | None) -> bool:
    """Whether a file may be written under a name; see `AtomicFile` for what `replace` says."""
    listing = OutputFileList(path.parent)
    if replace or not os.path.lexists(path) or is_stream(path):
        return True
    if replace is None and not listing.exists():
        return True
    return listing.owns(path.name)


@contextmanager
def atomic_file(path: Path, *, replace: bool | None = None) -> Iterator[Path]:
    """Gives a name to write to; the file takes its own name once the block is done.

    An older file stays until then, and stays if the block fails.

    Args:
        path: The name that the file will have.
        replace: As of `AtomicFile`.

    Raises:
        InputError: If `path` is a folder, a device or a pipe, or a file that must stay.
        OSError: If it cannot be written.
    """
    draft = AtomicFile(path, replace=replace)
    try:
        yield draft.temporary_path
        draft.commit()
    finally:
        draft.discard()


def write_text_atomically(path: Path, text: str, *, replace: bool | None = None) -> None:
    """A text file, whole or not at all; a device such as /dev/stdout just gets the text."""
    if is_stream(path):
        path.write_text(text, encoding="utf-8")
        return
    with atomic_file(path, replace=replace) as part:
        part.write_text(text, encoding="utf-8")


@contextmanager
def atomic_folder(path: Path, *, listed: bool = True) -> Iterator[Path]:
    """Gives a folder to fill; it takes its own name, and an older one's place, at the end.

    A link is followed, as by `atomic_file`. An older folder is replaced only if it is empty, or if
    its list says that all of it is ours.

    Args:
        path: The name that the folder will have.
        listed: Whether a list is made of what was written, by which it can be replaced later.

    Raises:
        InputError: If something there must stay.
        OSError: If it cannot be written.
    """
    check_replaceable_folder(path)
    real = Path(os.path.realpath(path))
    real.parent.mkdir(parents=True, exist_ok=True)
    part = real.with_name(_temporary_name(real.name, "part"))
    old = real.with_name(_temporary_name(real.name, "old"))
    if OutputFileList(real.parent).exists():
        OutputFileList(real.parent).add_temporary(part.name)
    part.mkdir()
    try:
        yield part
        if listed:
            _list_all(part)
        check_replaceable_folder(path)
        if real.exists():
            real.rename(old)
        try:
            part.rename(real)
        except BaseException:
            if old.exists():
                old.rename(real)
            raise
    finally:
        shutil.rmtree(part, ignore_errors=True)
        _remove_replaced(old, path)


def check_replaceable_folder(path: Path) -> None:
    """Refuse a folder that cannot be made, or with anything in it that this program did not write.

    Raises:
        InputError: Naming what is in the way.
    """
    file = next((parent for parent in path.absolute().parents if parent.is_file()), None)
    if file is not None:
        raise InputError(f"{path} cannot be a folder: {file} is a file.")
    if os.path.lexists(path) and not path.is_dir():
        raise InputError(f"{path} is a file; a folder was expected.")
    stranger = next(OutputFileList(path).foreign_files(), None)
    if stranger is not None:
        raise InputError(
            f"{path} holds {stranger}, which this program did not write there (or which was "
            "changed since), so the folder is not replaced. Name one that is empty or new."
        )


def _list_all(folder: Path) -> None:
    files = {str(p.relative_to(folder)): p for p in sorted(folder.rglob("*")) if p.is_file()}
    OutputFileList(folder).create()
    OutputFileList(folder).add_all(files)


def _remove_replaced(old: Path, path: Path) -> None:
    """Removes a folder that gave way, file by file: what came into it meanwhile is not lost."""
    if not old.exists():
        return
    OutputFileList(old).remove_all()
    try:
        old.rmdir()
    except OSError:
        raise InputError(
            f"Files came into {path} while it was replaced; they lie in {old}."
        ) from None


def _temporary_name(name: str, kind: str) -> str:
    """Return an unused name of a length that every file system takes."""
    return f".{name[:100]}.{secrets.token_hex(8)}.{kind}"


STREAM_PATH = re.compile(r"/dev/(stdin|stdout|stderr|fd/\d+)|/proc/(self|\d+)/fd/\d+")
"""Paths of open streams, which are never replaced."""


def is_stream(path: Path) -> bool:
    """Whether a name is that of a device or a pipe; stdout is one wherever it was sent to."""
    named = STREAM_PATH.fullmatch(str(path.absolute())) is not None
    return named or (path.exists() and not (path.is_file() or path.is_dir()))

"""Write files and folders whole or not at all, and never over a file of another program.

Which files of a folder are ours says a list in it: a file is ours if the list holds its name
together with the hash of what it holds now. A file that another program wrote or changed is
therefore never taken for ours; a copied folder is.
"""

import functools
import hashlib
import json
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from capture.input_error import InputError

RESERVED_PREFIX = ".instant-avatar-"
"""Of all names that are not for users."""
LIST_NAME = f"{RESERVED_PREFIX}files"
"""Of the list, in the folder whose files it lists."""
HEADER = b'{"program": "instant-avatar-stream", "list": "files it wrote here", "format": 1}'
"""First line of every list; a file without it is not a list of ours."""


@dataclass(frozen=True)
class OutputFileList:
    """The list of one folder, or the place for it.

    Each line is appended, and on the disk, before the file that it names appears: a process that
    is killed between the two leaves a line too many, and never a file of ours that is not listed.

    Attributes:
        folder: The folder; names are relative to it.
    """

    folder: Path

    @property
    def path(self) -> Path:
        """The list itself."""
        return self.folder / LIST_NAME

    def exists(self) -> bool:
        """Whether there is one, and it is ours."""
        return self._beginning() == HEADER

    def path_is_foreign(self) -> bool:
        """Whether something that is no list of ours has its name; one cut short is ours."""
        beginning = self._beginning()
        if beginning is None:
            return os.path.lexists(self.path)
        return not HEADER.startswith(beginning)

    def create(self) -> None:
        """Begins the list, unless there is one.

        Raises:
            InputError: If a foreign file has the list's name.
            OSError: If the disk is full.
        """
        if self.exists():
            return
        if self.path_is_foreign():
            raise InputError(
                f"{self.path} is not a list that this program wrote. Move it elsewhere, or name "
                "another folder."
            )
        self.path.write_bytes(HEADER)

    def add_all(self, files: dict[str, Path]) -> None:
        """Lists files that are about to take the names that they are listed under."""
        self._append([{"name": name, "sha256": file_sha256(file)} for name, file in files.items()])

    def add_temporary(self, name: str) -> None:
        """Lists the random name of a file or folder that this process is still writing."""
        self._append([{"unfinished": name, "pid": os.getpid()}])

    def owns(self, name: str) -> bool:
        """Whether a file of this name is there, and is what was listed under it."""
        try:
            found = file_sha256(self.folder / name)
        except OSError:
            return False
        return found in self._listed().get(name, ())  # read last: a run may be writing both

    def remove(self, name: str) -> bool:
        """Removes a file if it is ours.

        Returns:
            Whether none is there now.
        """
        if self.owns(name):
            (self.folder / name).unlink()
        return not os.path.lexists(self.folder / name)

    def foreign_files(self) -> Iterator[str]:
        """Whatever lies in the folder, at any depth, and is not ours."""
        listed = self._listed()
        above = {str(parent) for name in listed for parent in Path(name).parents}
        for folder, folders, files in os.walk(self.folder):
            place = Path(folder).relative_to(self.folder)
            for name in sorted(files):
                own = place / name == Path(LIST_NAME) and self.exists()
                if not own and not (str(place / name) in listed and self.owns(str(place / name))):
                    yield str(place / name)
            for name in sorted(folders):
                if str(place / name) not in above or Path(folder, name).is_symlink():
                    yield str(place / name)

    def remove_all(self) -> None:
        """Removes all files that are ours, folders that are empty then, and the list at the end."""
        listed = self._listed()
        for name in listed:
            self.remove(name)
        folders = {str(parent) for name in listed for parent in Path(name).parents} - {"."}
        for name in sorted(folders, key=len, reverse=True):
            with suppress(OSError):  # a foreign file is in it
                (self.folder / name).rmdir()
        self.remove_temporaries()
        self.remove_if_empty()

    def remove_if_empty(self) -> None:
        """Removes the list if nothing else lies in the folder, except a lock of ours."""
        if self.exists() and all(p.name.startswith(RESERVED_PREFIX) for p in self.folder.iterdir()):
            self.path.unlink()

    def remove_temporaries(self) -> None:
        """Removes what processes that were killed left half-written."""
        for record in self._records():
            name, pid = record.get("unfinished"), record.get("pid")
            if isinstance(name, str) and isinstance(pid, int) and not _process_exists(pid):
                unfinished = self.folder / Path(name).name
                if unfinished.is_dir() and not unfinished.is_symlink():
                    if unfinished.suffix == ".part":  # never a user's, whatever a list says
                        shutil.rmtree(unfinished, ignore_errors=True)
                else:
                    unfinished.unlink(missing_ok=True)

    def _beginning(self) -> bytes | None:
        """As many bytes as the header has; None if there is no file to be read."""
        if not self.path.is_file():
            return None
        try:
            with self.path.open("rb") as file:
                return file.read(len(HEADER))
        except OSError:
            return None

    def _append(self, records: list[dict[str, Any]]) -> None:
        lines = "".join("\n" + json.dumps(record) for record in records)
        with self.path.open("ab") as file:  # begins a line: an older one may have been cut short
            file.write(lines.encode())
            file.flush()
            os.fsync(file.fileno())

    def _records(self) -> Iterator[dict[str, Any]]:
        if not self.exists():
            return
        for line in self.path.read_bytes().splitlines()[1:]:
            with suppress(ValueError):  # cut short by a power failure
                record = json.loads(line)
                if isinstance(record, dict):
                    yield record

    def _listed(self) -> dict[str, frozenset[str]]:
        """What each name's file may hold: its content now, or of earlier writings."""
        found: dict[str, frozenset[str]] = {}
        for record in self._records():
            name, known = record.get("name"), record.get("sha256")
            if isinstance(name, str) and isinstance(known, str):
                found[name] = found.get(name, frozenset()) | {known}
        return found


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's content; computed once for as long as the file is not written to.

    Raises:
        OSError: If it cannot be read.
    """
    if not path.is_file():  # a pipe would never end
        raise FileNotFoundError(path)
    state = path.stat()
    return _cached_sha256(path, state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns)


@functools.lru_cache(maxsize=1024)
def _cached_sha256(path: Path, *_: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _process_exists(pid: int) -> bool:
    """Whether a process of this machine has that number."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it is another user's
        return True
    return True


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
        self._real_path = real = Path(os.path.realpath(path))
        real.parent.mkdir(parents=True, exist_ok=True)
        self.temporary_path = real.with_name(_temporary_name(path.stem, "part") + path.suffix)
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
            self._list.add_all({self._path.name: self.temporary_path})
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

    An older file stays until then, and stays if the block fails. Arguments and errors are those of
    `AtomicFile`.
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
            files = {str(p.relative_to(part)): p for p in sorted(part.rglob("*")) if p.is_file()}
            OutputFileList(part).create()
            OutputFileList(part).add_all(files)
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

"""Write files and folders whole or not at all, and never over a file of another program.

A folder of ours has a marker file with the names that were written there. A file that the marker
does not name is never replaced or removed, whatever it is called.
"""

import json
import os
import re
import secrets
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import final

import psutil

from capture.input_error import InputError

RESERVED_PREFIX = ".instant-avatar-"
"""Prefix of all names that are not for users."""
LIST_NAME = f"{RESERVED_PREFIX}files"
"""Name of the marker."""
HEADER = b'{"program": "instant-avatar-stream", "list": "files it wrote here", "format": 1}'
"""First line of every marker."""
TEMPORARY_PATTERN = re.compile(r"\.instant-avatar-(\d+)-[0-9a-f]{16}\.(part|old)(\.\w+)?")
"""Name of an unfinished file or folder, with the number of the process that writes it."""


@dataclass(frozen=True)
class OutputFileList:
    """The marker of one folder: its header, and a line for each name, relative to the folder.

    A name is listed, and on the disk, before its file appears: a process that is killed between
    the two leaves a line too many, and never a file of ours that is not listed.
    """

    folder: Path

    @property
    def path(self) -> Path:
        """The marker itself."""
        return self.folder / LIST_NAME

    def exists(self) -> bool:
        """Return whether the folder has a marker."""
        try:
            return self.path.read_bytes().startswith(HEADER)
        except OSError:
            return False

    def create(self) -> None:
        """Begin the marker, unless there is one; an InputError if a foreign file has its name."""
        if self.exists():
            return
        if self.path.is_file() and not HEADER.startswith(self.path.read_bytes()):  # else cut short
            raise InputError(
                f"{self.path} was not written by this program. Move it, or name another folder."
            )
        self.path.write_bytes(HEADER)

    def names(self) -> frozenset[str]:
        """Names that were written here, at any depth."""
        listed = set()
        for line in self.path.read_bytes().splitlines()[1:] if self.exists() else ():
            with suppress(ValueError, KeyError, TypeError):  # cut short by a power failure
                listed.add(Path(json.loads(line)["name"]))
        within = (name for name in listed if not name.is_absolute() and ".." not in name.parts)
        return frozenset(map(str, within))

    def add(self, names: Iterable[str]) -> None:
        """List files that are about to take their names."""
        new = sorted(set(names) - self.names())
        if new:
            with self.path.open("ab") as file:
                file.write("".join("\n" + json.dumps({"name": name}) for name in new).encode())
                file.flush()
                os.fsync(file.fileno())

    def owns(self, name: str) -> bool:
        """Return whether a file of this name exists and was written by this program."""
        return (self.folder / name).is_file() and name in self.names()

    def remove(self, name: str) -> bool:
        """Remove a file if it is ours; return whether none is there now."""
        if self.owns(name):
            (self.folder / name).unlink(missing_ok=True)
        return not os.path.lexists(self.folder / name)

    def foreign_files(self) -> Iterator[str]:
        """Yield whatever lies in the folder, at any depth, and is not ours."""
        listed = self.names()
        above = {str(parent) for name in listed for parent in Path(name).parents}
        ours = listed | ({LIST_NAME} if self.exists() else set())
        for folder, folders, files in os.walk(self.folder):
            place = Path(folder).relative_to(self.folder)
            yield from (
                str(place / name) for name in sorted(files) if str(place / name) not in ours
            )
            for name in sorted(folders):
                if str(place / name) not in above or Path(folder, name).is_symlink():
                    yield str(place / name)

    def remove_all(self) -> None:
        """Remove all files that are ours, folders that are empty then, and the marker at last."""
        listed = self.names()
        for name in listed:
            if (self.folder / name).is_file():
                (self.folder / name).unlink()
        folders = {str(parent) for name in listed for parent in Path(name).parents} - {"."}
        for name in sorted(folders, key=len, reverse=True):
            with suppress(OSError):  # a foreign file is in it
                (self.folder / name).rmdir()
        self.remove_temporaries()
        self.remove_if_empty()

    def remove_if_empty(self) -> None:
        """Remove the marker if nothing else lies in the folder, except a lock of ours."""
        if self.exists() and all(p.name.startswith(RESERVED_PREFIX) for p in self.folder.iterdir()):
            self.path.unlink()

    def remove_temporaries(self) -> None:
        """Remove what killed processes left half-written."""
        for path in self.folder.iterdir() if self.folder.is_dir() else ():
            match = TEMPORARY_PATTERN.fullmatch(path.name)
            if match is None or psutil.pid_exists(int(match[1])):
                continue
            if path.is_dir() and match[2] == "old":  # only what was ours gave way
                OutputFileList(path).remove_all()
                with suppress(OSError):
                    path.rmdir()
            elif path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


def is_replaceable(path: Path, replace: bool | None) -> bool:
    """Return whether a file may be written under a name.

    `replace` tells whether a file that no marker names may be replaced; None: only in a folder
    without a marker.
    """
    if replace or not os.path.lexists(path) or is_stream(path):
        return True
    marker = OutputFileList(path.parent)
    return marker.owns(path.name) if marker.exists() else replace is None


@final
class AtomicFile:
    """A file under a temporary name beside its own, which it takes when it is finished.

    The target of a link is replaced. The temporary name keeps the suffix, by which encoders choose
    a format. Write to `temporary_path`; an older file stays until `commit`.
    """

    def __init__(self, path: Path, *, replace: bool | None = None) -> None:
        """Make the empty file, and folders above it; `replace` is that of `is_replaceable`."""
        self._path, self._replace = path, replace
        if path.is_dir():
            raise InputError(f"{path} is a folder; the name of a file was expected.")
        if is_stream(path):
            raise InputError(f"{path} is a device or a pipe; the name of a file was expected.")
        self._check_replaceable()
        self._real_path = Path(os.path.realpath(path))
        self._real_path.parent.mkdir(parents=True, exist_ok=True)
        self.temporary_path = self._real_path.with_name(_temporary_name("part", path.suffix))
        self.temporary_path.touch(exist_ok=False)

    def commit(self) -> None:
        """Flush the file to the disk and give it its name."""
        with self.temporary_path.open("r+b") as file:
            os.fsync(file.fileno())
        self._check_replaceable()
        marker = OutputFileList(self._path.parent)
        if marker.exists():
            marker.add([self._path.name])
        self.temporary_path.replace(self._real_path)

    def discard(self) -> None:
        """Remove what was not finished."""
        self.temporary_path.unlink(missing_ok=True)

    def _check_replaceable(self) -> None:
        if not is_replaceable(self._path, self._replace):
            raise InputError(
                f"{self._path} is there already, and was not written by this program; it was left "
                "alone. Move it, or name another place."
            )


@contextmanager
def atomic_file(path: Path, *, replace: bool | None = None) -> Iterator[Path]:
    """Yield a name to write to; the file takes its own name once the block is done.

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
    """Write a text file, whole or not at all; a device such as /dev/stdout just gets the text."""
    if is_stream(path):
        path.write_text(text, encoding="utf-8")
        return
    with atomic_file(path, replace=replace) as part:
        part.write_text(text, encoding="utf-8")


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield a folder to fill; it takes its own name, and an older one's place, at the end.

    A link is followed, as by `atomic_file`. An older folder is replaced only if it is empty, or if
    its marker names all that is in it; else an InputError is raised.
    """
    check_replaceable_folder(path)
    real = Path(os.path.realpath(path))
    real.parent.mkdir(parents=True, exist_ok=True)
    part, old = (real.with_name(_temporary_name(kind)) for kind in ("part", "old"))
    part.mkdir()
    try:
        yield part
        names = [str(p.relative_to(part)) for p in part.rglob("*") if p.is_file()]
        marker = OutputFileList(part)
        marker.create()
        marker.add(names)
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
    if old.exists():
        OutputFileList(old).remove_all()
        old.rmdir()


def check_replaceable_folder(path: Path) -> None:
    """Refuse a folder that cannot be made, or with anything in it that this program did not write.

    The InputError names what is in the way.
    """
    file = next((parent for parent in path.absolute().parents if parent.is_file()), None)
    if file is not None:
        raise InputError(f"{path} cannot be a folder: {file} is a file.")
    if os.path.lexists(path) and not path.is_dir():
        raise InputError(f"{path} is a file; a folder was expected.")
    stranger = next(OutputFileList(path).foreign_files(), None)
    if stranger is not None:
        raise InputError(
            f"{path} holds {stranger}, which this program did not write there, so the folder is "
            "not replaced. Name one that is empty or new."
        )


def _temporary_name(kind: str, suffix: str = "") -> str:
    return f"{RESERVED_PREFIX}{os.getpid()}-{secrets.token_hex(8)}.{kind}{suffix}"


def is_stream(path: Path) -> bool:
    """Return whether a name is that of a device or a pipe; stdout is one wherever it leads."""
    streams = r"/dev/(stdin|stdout|stderr|fd/\d+)|/proc/(self|\d+)/fd/\d+"
    named = re.fullmatch(streams, str(path.absolute())) is not None
    return named or (path.exists() and not (path.is_file() or path.is_dir()))

"""Which files of a folder this program wrote: known by name and content, from a list in the folder.

A file is ours if the list holds its name together with the hash of what it holds now. A file
that another program wrote or changed is therefore never taken for ours; a copied folder is.
"""

import functools
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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

    def add(self, name: str, content: Path) -> None:
        """Lists a file that is about to take its name.

        Args:
            name: The name it will have.
            content: Where it lies now.
        """
        self.add_all({name: content})

    def add_all(self, files: dict[str, Path]) -> None:
        """Lists several files, by the names they will have."""
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

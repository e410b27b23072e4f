"""Files that appear whole or not at all."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from capture.errors import BadInput


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Gives a name to write to; the file takes its own name once the block is done.

    The passing name keeps the suffix, by which encoders know what to write. An older file stays
    until then, and stays if the block fails.

    Raises:
        BadInput: If `path` is a folder.
        OSError: If it cannot be written.
    """
    if path.is_dir():
        raise BadInput(f"{path} is a folder; the name of a file was expected.")
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
    """Gives a folder to fill; it takes its own name, and an older one's place, at the end."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    old = path.with_name(f".{path.name}.{os.getpid()}.old")
    part.mkdir()
    try:
        yield part
        if path.exists():
            path.rename(old)
        part.rename(path)
    finally:
        shutil.rmtree(part, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """A text file, whole or not at all."""
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")

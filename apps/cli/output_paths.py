"""Where a command may write: asked before any work is done for what goes there."""

import os
import shlex
import tempfile
from collections.abc import Iterable
from pathlib import Path

from capture.atomic_files import check_replaceable_folder, is_replaceable, is_stream
from capture.input_error import InputError
from capture.output_file_list import RESERVED_PREFIX


def check_writable(path: Path, flag: str) -> None:
    """Whether something can be written there; tried out, and nothing is left behind.

    Args:
        path: A file or a folder; it and folders above it need not be there yet.
        flag: Which argument named it.

    Raises:
        InputError: If that cannot be.
    """
    place = Path(os.path.abspath(path))
    while not place.exists() and place != place.parent:
        place = place.parent
    if place.is_file() and place.absolute() != Path(os.path.abspath(path)):
        raise InputError(f"{flag} is {path}, but {place} is a file and holds nothing.")
    folder = place.parent if place.is_file() else place  # a file is replaced, not written into
    try:
        os.rmdir(tempfile.mkdtemp(prefix=RESERVED_PREFIX, dir=folder))
    except OSError as error:
        raise InputError(
            f"{flag} is {path}, but {folder} cannot be written to ({error.strerror}). Name another "
            "place."
        ) from None


def check_output_file(
    path: Path, flag: str, inputs: Iterable[Path] = (), *, overwrite: bool | None = None
) -> None:
    """Whether a file may be written there.

    Args:
        path: Where to.
        flag: Which argument named it.
        inputs: What the command reads; no output is one of them, nor lies in one.
        overwrite: Whether a file that is there already may go; None: where no list of the folder
            says otherwise.

    Raises:
        InputError: If not.
    """
    if path.is_dir():
        raise InputError(f"{flag} is {path}, which is a folder; the name of a file was expected.")
    if is_stream(path):
        return
    for given in inputs:
        if _is_same_file(path, given):
            raise InputError(
                f"{flag} is {path}, which is an input of this command ({given}); inputs are never "
                f"written to. Name another file: {flag} {shlex.quote(str(unused_path(path)))}"
            )
        if _is_same_file(path.parent, given):
            other = (
                Path(os.path.relpath(given.resolve().parent))
                / f"{_resolved_name(given)}-{path.name}"
            )
            raise InputError(
                f"{flag} is {path}, which lies in an input of this command ({given}): what lies "
                f"there is read as a part of it. Name another file: {flag} "
                f"{shlex.quote(str(unused_path(other)))}"
            )
    if not is_replaceable(path, overwrite):
        raise InputError(
            f"{flag} is {path}, which is there already. Replace it with --overwrite, or name "
            f"another file: {flag} {shlex.quote(str(unused_path(path)))}"
        )
    check_writable(path, flag)


def check_output_folder(path: Path, flag: str, inputs: Iterable[Path] = ()) -> None:
    """Whether a folder may be written there; an older one gives way if all of it is ours.

    Args:
        path: Where to.
        flag: Which argument named it.
        inputs: What the command reads.

    Raises:
        InputError: If not.
    """
    check_disjoint_from_inputs(path, flag, inputs)
    check_replaceable_folder(path)
    check_writable(path, flag)


def check_disjoint_from_inputs(folder: Path, flag: str, inputs: Iterable[Path]) -> None:
    """Refuses an output folder that is an input, holds one, or lies in one.

    Args:
        folder: Where a command will write.
        flag: Which argument named it.
        inputs: What it reads: files and folders.

    Raises:
        InputError: With the name of a folder that may be used.
    """
    inputs = list(inputs)
    for given in inputs:
        clash = _describe_overlap(folder, given)
        if clash is not None:
            raise InputError(
                f"{flag} {folder} {clash} an input of this command ({given.absolute()}): nothing "
                "is written where inputs lie. Name a folder of its own: "
                f"{flag} {shlex.quote(str(_suggest_disjoint_folder(given, inputs)))}"
            )


def unused_path(path: Path) -> Path:
    """The path, or one with a number behind its name: the first that is not taken."""
    number, free = 1, path
    while os.path.lexists(free):
        number += 1
        free = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return free


def _describe_overlap(folder: Path, given: Path) -> str | None:
    """How an output folder and an input get in each other's way."""
    if _is_same_file(folder, given):
        return "is"
    if given.is_dir() and any(_is_same_file(above, given) for above in _real_path(folder).parents):
        return "lies in"
    if any(_is_same_file(above, folder) for above in _real_path(given).parents):
        return "holds"
    return None


def _suggest_disjoint_folder(given: Path, inputs: list[Path]) -> Path:
    """A folder that is not there yet, beside an input and outside of all."""
    place = _real_path(given)
    while True:
        free = unused_path(place.with_name(f"{place.stem}-run"))
        if place == place.parent or not any(_describe_overlap(free, other) for other in inputs):
            return Path(os.path.relpath(free)) if not given.is_absolute() else free
        place = place.parent


def _is_same_file(one: Path, other: Path) -> bool:
    """Whether two paths are one file, also by a link, or in another case where case is nothing."""
    if _real_path(one) == _real_path(other):
        return True
    try:
        return one.samefile(other)
    except OSError:  # one is not there
        return False


def _real_path(path: Path) -> Path:
    return Path(os.path.realpath(path))


def _resolved_name(path: Path) -> str:
    return path.resolve().name

"""Checks of output paths, before any work is done for them."""

import os
import shlex
import tempfile
from collections.abc import Iterable
from pathlib import Path

from capture.atomic_files import (
    RESERVED_PREFIX,
    check_replaceable_folder,
    is_replaceable,
    is_stream,
)
from capture.input_error import InputError


def check_writable(path: Path, flag: str) -> None:
    """Check by trial that a path can be written; nothing is left behind.

    Args:
        path: A file or a folder; it and its parents need not exist yet.
        flag: The argument that names the path.

    Raises:
        InputError: If the path cannot be written.
    """
    place = Path(os.path.abspath(path))
    while not place.exists() and place != place.parent:
        place = place.parent
    if place.is_file() and place.absolute() != Path(os.path.abspath(path)):
        raise InputError(f"{flag} is {path}, but {place} is a file.")
    folder = place.parent if place.is_file() else place  # a file is replaced, not written into
    try:
        os.rmdir(tempfile.mkdtemp(prefix=RESERVED_PREFIX, dir=folder))
    except OSError as error:
        raise InputError(
            f"{flag} is {path}, but {folder} is not writable ({error.strerror}). Choose another "
            "path."
        ) from None


def check_output_file(
    path: Path,
    flag: str,
    inputs: Iterable[Path] = (),
    *,
    overwrite: bool | None = None,
    below: bool = True,
) -> None:
    """Check that an output file may be written.

    Args:
        path: The file to write.
        flag: The argument that names the file.
        inputs: Files and folders that the command reads; an output may not lie in one of them.
        overwrite: Whether an existing file may be replaced; None: unless the folder's list of
            written files forbids it.
        below: Whether the file may lie in a folder within an input.

    Raises:
        InputError: If the file may not be written.
    """
    if path.is_dir():
        raise InputError(f"{flag} is {path}, which is a folder, but must be a file.")
    if is_stream(path):
        return
    for given in inputs:
        if _is_same_file(path, given):
            raise InputError(
                f"{flag} is {path}, which is an input of this command ({given}); inputs are never "
                f"written to. Choose another file: {flag} {shlex.quote(str(unused_path(path)))}"
            )
        lies_in = not below and _describe_overlap(path, given) == "lies in"
        if lies_in or _is_same_file(path.parent, given):
            other = (
                Path(os.path.relpath(given.resolve().parent))
                / f"{_resolved_name(given)}-{path.name}"
            )
            raise InputError(
                f"{flag} is {path}, which lies in an input of this command ({given}), where it "
                f"would be read as part of it. Choose another file: {flag} "
                f"{shlex.quote(str(unused_path(other)))}"
            )
    if not is_replaceable(path, overwrite):
        raise InputError(
            f"{flag} {path} already exists. Pass --overwrite to replace it, or choose another "
            f"file: {flag} {shlex.quote(str(unused_path(path)))}"
        )
    check_writable(path, flag)


def check_output_folder(path: Path, flag: str, inputs: Iterable[Path] = ()) -> None:
    """Check that an output folder may be written; an older one is replaced if all of it is ours.

    Args:
        path: The folder to write.
        flag: The argument that names the folder.
        inputs: Files and folders that the command reads.

    Raises:
        InputError: If the folder may not be written.
    """
    check_disjoint_from_inputs(path, flag, inputs)
    check_replaceable_folder(path)
    check_writable(path, flag)


def check_disjoint_from_inputs(folder: Path, flag: str, inputs: Iterable[Path]) -> None:
    """Refuse an output folder that is an input, contains one, or lies in one.

    Args:
        folder: The folder to write.
        flag: The argument that names the folder.
        inputs: Files and folders that the command reads.

    Raises:
        InputError: With a suggestion for another folder.
    """
    inputs = list(inputs)
    for given in inputs:
        clash = _describe_overlap(folder, given)
        if clash is not None:
            raise InputError(
                f"{flag} {folder} {clash} an input of this command ({given.absolute()}): nothing "
                "is written next to inputs. Choose a separate folder: "
                f"{flag} {shlex.quote(str(_suggest_disjoint_folder(given, inputs)))}"
            )


def unused_path(path: Path) -> Path:
    """Return the path, or its first numbered variant that does not exist."""
    number, free = 1, path
    while os.path.lexists(free):
        number += 1
        free = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return free


def _describe_overlap(folder: Path, given: Path) -> str | None:
    """Return how an output folder overlaps an input; None if it does not."""
    if _is_same_file(folder, given):
        return "is"
    if given.is_dir() and any(_is_same_file(above, given) for above in _real_path(folder).parents):
        return "lies in"
    if any(_is_same_file(above, folder) for above in _real_path(given).parents):
        return "contains"
    return None


def _suggest_disjoint_folder(given: Path, inputs: list[Path]) -> Path:
    """Return an unused folder next to an input and outside of all inputs."""
    place = _real_path(given)
    while True:
        free = unused_path(place.with_name(f"{place.stem}-run"))
        if place == place.parent or not any(_describe_overlap(free, other) for other in inputs):
            return Path(os.path.relpath(free)) if not given.is_absolute() else free
        place = place.parent


def _is_same_file(one: Path, other: Path) -> bool:
    """Whether two paths are one file, also by links, or on case-insensitive file systems."""
    if _real_path(one) == _real_path(other):
        return True
    try:
        return one.samefile(other)
    except OSError:  # one does not exist
        return False


def _real_path(path: Path) -> Path:
    return Path(os.path.realpath(path))


def _resolved_name(path: Path) -> str:
    return path.resolve().name

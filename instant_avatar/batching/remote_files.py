"""Files behind paths and URLs (s3://, gs://, https://, …), through fsspec.

Credentials are the environment's.
"""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from capture.input_error import InputError, install_command

VERSION_KEYS = ("ETag", "etag", "md5Hash", "LastModified", "updated", "mtime", "created")
"""Keys that tell whether a remote file has changed, best first."""


class RemoteFileError(OSError):
    """A remote file system refused or failed; the message names the URL."""


class ListedFile(NamedTuple):
    """A file of a listing: its size in bytes, and what changes when its content does."""

    size: int
    version: str


def is_url(place: str) -> bool:
    """True if a path is a URL."""
    return "://" in place


@contextmanager
def open_remote(url: str) -> Iterator[tuple[Any, str]]:
    """Yield the file system of a URL, and the path in it.

    Raises:
        InputError: If a package is missing, or the kind of URL is unknown.
        RemoteFileError: For whatever the file system raises during the block.
    """
    try:
        from fsspec.core import url_to_fs

        system, path = url_to_fs(url, use_listings_cache=False)
    except (ImportError, ValueError) as error:
        raise InputError(
            f"{url} cannot be read: {error}. Most kinds need: {install_command('cluster')} (gs:// "
            "needs gcsfs, too)."
        ) from error
    try:
        yield system, path.rstrip("/")
    except Exception as error:  # each file system has errors of its own
        raise RemoteFileError(f"{url}: {type(error).__name__}: {error}") from error


def list_files(place: str) -> dict[str, ListedFile]:
    """List a file, or all files below a folder, by path or URL; hidden ones are left out.

    Nothing is listed if it does not exist.
    """
    if not is_url(place):
        return {file.as_posix(): _local_state(file) for file in _walk(Path(place))}
    try:
        with open_remote(place) as (system, path):
            if not system.exists(path):
                return {}
            entry = system.info(path)
            is_file = entry["type"] == "file"
            entries = {path: entry} if is_file else system.find(path, detail=True)
    except RemoteFileError as error:
        raise InputError(f"{error}. Check the address, and the credentials.") from error
    files = {}
    for name, entry in sorted(entries.items()):
        below = name.removeprefix(path)
        if "/." not in below:
            version = next((str(entry[key]) for key in VERSION_KEYS if entry.get(key)), "")
            files[place.rstrip("/") + below] = ListedFile(int(entry["size"] or 0), version)
    return files


def _walk(place: Path) -> Iterator[Path]:
    """Yield a local file, or those below a folder; links are followed, unlike by fsspec."""
    if place.is_file():
        yield place
    for folder, folders, names in os.walk(place, followlinks=True):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        files = (Path(folder, name) for name in sorted(names) if not name.startswith("."))
        yield from filter(Path.is_file, files)


def _local_state(file: Path) -> ListedFile:
    state = file.stat()
    return ListedFile(state.st_size, str(state.st_mtime_ns))


def read_text(place: str) -> str:
    """Read a text file by path or URL."""
    try:
        if not is_url(place):
            return Path(place).read_text(encoding="utf-8-sig")
        with open_remote(place) as (system, path):
            return system.cat_file(path).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{place} cannot be read: {error}.") from error


def fetch_files(roots: Iterable[str], sources: Iterable[str], folder: Path) -> dict[str, str]:
    """Fetch files and folders; return the local path of each.

    `roots` are URLs of files and folders, `sources` those of the files at or below them.
    """
    local = {
        root: f"{folder}/{number}/{root.rsplit('/', 1)[1]}" for number, root in enumerate(roots)
    }
    for root, target in local.items():
        urls = [url for url in sources if f"{url}/".startswith(f"{root}/")]
        with open_remote(root) as (system, path):
            names = [path + url.removeprefix(root) for url in urls]
            system.get(names, [target + url.removeprefix(root) for url in urls])
    return local

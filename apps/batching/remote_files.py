"""Files behind URLs (s3://, gs://, http://, …), and the folders on a node's disk for fetched ones.

URLs are read through fsspec; credentials are the environment's. Local folders are listed in the
same form, so that captures are found in both alike.
"""

import os
import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from apps.cli.command_line import CommandExit
from capture.input_error import InputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

URL = re.compile(r"[a-z][a-z0-9+.-]*://", re.IGNORECASE)
"""Start of a URL."""
VERSION_KEYS = ("ETag", "etag", "md5Hash", "LastModified", "updated", "mtime", "created")
"""What tells that a remote file has changed, best first."""
WORK_PREFIX = "ia-batch-"
"""Start of the names of work folders on a node's disk."""
WORK_PATTERN = re.compile(rf"{WORK_PREFIX}\d+-\d+")
"""Names of work folders: process and time."""
LOCK_NAME = "in-use"
"""File in a work folder: locked as long as its process lives; holds the bytes it has reserved."""
DISK_POLL_S = 0.5
"""Interval at which a full disk budget is looked at again, seconds."""


class RemoteFileError(OSError):
    """A remote file system refused or failed; the message names the URL."""


class ListedFile(NamedTuple):
    """A file of a listing: its size in bytes, and what changes when its content does."""

    size: int
    version: str


def is_url(path: object) -> bool:
    """Whether a path is a URL."""
    return URL.match(str(path)) is not None


def list_files(place: str) -> dict[str, ListedFile]:
    """List a file, or all files below a folder, by path or URL; hidden ones are left out.

    Args:
        place: Path or URL. Nothing is found if it does not exist.

    Raises:
        InputError: If the URL cannot be listed.
    """
    return _list_remote(place) if is_url(place) else dict(_list_local(Path(place)))


def _list_local(place: Path) -> Iterator[tuple[str, ListedFile]]:
    if place.is_file():
        state = place.stat()
        yield place.as_posix(), ListedFile(state.st_size, str(state.st_mtime_ns))
        return
    for folder, folders, names in os.walk(place, followlinks=True):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(names):
            path = Path(folder, name)
            if not name.startswith(".") and path.is_file():
                state = path.stat()
                yield path.as_posix(), ListedFile(state.st_size, str(state.st_mtime_ns))


def _list_remote(url: str) -> dict[str, ListedFile]:
    try:
        with explain_errors(url, "list"):
            system, path = open_remote(url)
            found = _find(system, path)
    except RemoteFileError as error:
        raise InputError(f"{error}. Check the address, and the credentials.") from error
    files, base = {}, path.rstrip("/")
    for name, entry in sorted(found.items()):
        below = name.removeprefix(base)
        if "/." not in below and entry.get("size") is not None:
            version = next((str(entry[key]) for key in VERSION_KEYS if entry.get(key)), "")
            files[url.rstrip("/") + below] = ListedFile(int(entry["size"]), version)
    return files


def _find(system: Any, path: str) -> dict[str, dict[str, Any]]:
    """Return the entries of a file, or of all files below a folder; none if it does not exist."""
    try:
        entry = system.info(path)
    except FileNotFoundError:
        return {}
    if entry.get("mimetype") == "text/html":
        raise InputError(
            f"{path} is a web page: web servers list no folders. Name the files in a manifest "
            "(docs/batch.md)."
        )
    return {path: entry} if entry["type"] == "file" else system.find(path, detail=True)


def open_remote(url: str) -> tuple[Any, str]:
    """Return the file system of a URL, and the path in it.

    Raises:
        InputError: If a package is missing, or the kind of URL is unknown.
    """
    try:
        from fsspec.core import url_to_fs

        return url_to_fs(url, use_listings_cache=False)
    except (ImportError, ValueError) as error:
        raise InputError(
            f"{url} cannot be read: {error}. Most are covered by: pip install "
            "'instant-avatar-stream[cluster]' (gs:// needs gcsfs)."
        ) from error


def read_text(place: str) -> str:
    """Read a text file by path or URL.

    Raises:
        InputError: If it cannot be read.
    """
    try:
        if not is_url(place):
            return Path(place).read_text(encoding="utf-8-sig")
        with explain_errors(place, "read"):
            system, path = open_remote(place)
            return system.cat_file(path).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{place} cannot be read: {error}.") from error


def fetch_inputs(
    sources: tuple[tuple[str, int], ...], video: str, options: Mapping[str, Any], folder: Path
) -> tuple[str, dict[str, Any]]:
    """Fetch the files of a capture into a folder; return its local video and options.

    Args:
        sources: URL and size of each file; all lie at or below the URLs in `video` and `options`.
        video: Path or URL.
        options: Of ia-ingest; values may be URLs.
        folder: Where to write.

    Raises:
        RemoteFileError: If a file cannot be fetched, or has another size than listed.
    """
    local = {}
    for root in filter(is_url, [video, *map(str, options.values())]):
        local[root] = folder / str(len(local)) / root.rstrip("/").rsplit("/", 1)[1]
    for url, size in sources:
        root = next(root for root in local if (url + "/").startswith(root.rstrip("/") + "/"))
        path = local[root].joinpath(*url[len(root.rstrip("/")) :].strip("/").split("/"))
        path = Path(str(path).rstrip("/"))
        path.parent.mkdir(parents=True, exist_ok=True)
        with explain_errors(url, "fetch"):
            system, name = open_remote(url)
            system.get_file(name, str(path))
        if path.stat().st_size != size:
            raise RemoteFileError(f"{url} has {path.stat().st_size} bytes; {size} were listed.")
    moved = {name: str(local.get(str(value), value)) for name, value in options.items()}
    kept = {name: value for name, value in options.items() if moved[name] == str(value)}
    return str(local.get(video, video)), {**moved, **kept}


def send_files(url: str, files: Mapping[str, bytes], *, last: str = "") -> None:
    """Write files below a URL; each appears whole, and `last` after all others.

    Raises:
        RemoteFileError: If a file cannot be written.
    """
    with explain_errors(url, "write to"):
        system, base = open_remote(url)
        for name in sorted(files, key=lambda name: name == last):
            path = f"{base.rstrip('/')}/{name}"
            system.makedirs(path.rsplit("/", 1)[0], exist_ok=True)
            system.pipe_file(path, files[name])


@contextmanager
def explain_errors(url: str, verb: str) -> Iterator[None]:
    """Turn whatever a remote file system raises into a `RemoteFileError`."""
    try:
        yield
    except (InputError, CommandExit):
        raise
    except Exception as error:  # each file system has errors of its own
        message = f"cannot {verb} {url}: {type(error).__name__}: {error}"
        raise RemoteFileError(message) from error


@contextmanager
def work_folder(
    place: Path, wanted_bytes: int, budget_bytes: int | None, stopped: Callable[[], bool]
) -> Iterator[Path]:
    """Make a folder on this node's disk for one attempt, and remove it afterwards.

    Folders of processes that were killed are removed as well: their locks are gone.

    Args:
        place: Folder for work folders, used by all attempts on this node.
        wanted_bytes: What will be fetched into the folder.
        budget_bytes: What all attempts on this node may have fetched at a time; None for any.
            Waits until there is room.
        stopped: Whether to give up waiting.

    Raises:
        InputError: If a capture alone exceeds the budget.
    """
    if budget_bytes is not None and wanted_bytes > budget_bytes:
        raise InputError(
            f"The capture has {wanted_bytes / 1e9:.2f} GB, but --disk allows "
            f"{budget_bytes / 1e9:.2f} GB on a node. Increase --disk."
        )
    place.mkdir(parents=True, exist_ok=True)
    folder, descriptor = _reserve(place, wanted_bytes, budget_bytes, stopped)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(descriptor)


def _reserve(
    place: Path, wanted: int, budget: int | None, stopped: Callable[[], bool]
) -> tuple[Path, int]:
    """Wait for room, then make a folder with a locked file; one process at a time decides."""
    while True:
        with _locked(place / LOCK_NAME):
            held = sum(_reserved_or_remove(folder) for folder in place.glob(f"{WORK_PREFIX}*"))
            if budget is None or held + wanted <= budget or stopped():
                folder = place / f"{WORK_PREFIX}{os.getpid()}-{time.monotonic_ns()}"
                folder.mkdir()
                descriptor = os.open(folder / LOCK_NAME, os.O_RDWR | os.O_CREAT, 0o666)
                if fcntl is not None:
                    fcntl.flock(descriptor, fcntl.LOCK_EX)
                os.write(descriptor, str(wanted).encode())
                return folder, descriptor
        time.sleep(DISK_POLL_S)


def _reserved_or_remove(folder: Path) -> int:
    """Return the bytes that a work folder has reserved; remove it if its process is gone."""
    if WORK_PATTERN.fullmatch(folder.name) is None or folder.is_symlink():
        return 0  # a user's, who likes the name
    try:
        with (folder / LOCK_NAME).open("rb+") as lock:
            if fcntl is None:
                return int(lock.read() or 0)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                return int(lock.read() or 0)
    except (OSError, ValueError):  # killed before it had a lock: it is empty, or a user's
        with suppress(OSError):
            folder.rmdir()
        return 0
    shutil.rmtree(folder, ignore_errors=True)
    return 0


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    with path.open("a") as file:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX)
        yield

"""A file's content as dictionaries, lists, numbers, texts and numpy arrays; nothing is run.

Three readers: `read_npz` and `read_pickled_arrays` for files whose keys are known, and
`read_untrusted_file` for files of any container, which is recognised by its first bytes: people
rename files. All raise InputError for a file that is missing or damaged, or holds anything that
would have to be executed, or is larger than `MAX_BYTES`.
"""

import io
import json
import sys
import zipfile
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from capture.image_folder import natural_sort_key
from capture.input_error import InputError
from preprocess.safe_pickle import UnsafePickleError, array_of, load_safe_pickle

MAX_BYTES = 1 << 30
"""Largest file, packed or unpacked (SMPL with 300 betas: a quarter of it)."""


@contextmanager
def explain_damage(path: Path, kind: str) -> Iterator[None]:
    """Turn any error of a damaged or foreign file in a block into one InputError that names it.

    `kind` is the format that the file was taken for.
    """
    try:
        yield
    except (InputError, PermissionError, ModuleNotFoundError):  # these explain themselves
        raise
    except UnsafePickleError as error:
        raise InputError(
            f"{path} is a pickle that asks to run {error}; it was refused and nothing was run. "
            "A body or pose file holds arrays only: get it from its authors again, or convert it "
            "to .npz."
        ) from None
    except Exception as cause:  # damaged files fail in any way: numpy reads headers as Python
        reason = str(cause).rstrip(".") or type(cause).__name__
        if isinstance(cause, KeyError):
            reason = f"{reason} is missing"
        elif isinstance(cause, (IndexError, TypeError, AttributeError)):
            reason = f"its parts do not fit together ({reason})"
        raise InputError(
            f"{path} cannot be read as {kind}: {reason}. Is the file complete? Readable formats "
            "are listed in docs/formats.md."
        ) from cause


def read_npz(
    path: Path, keys: tuple[str, ...] | None = None
) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Read the arrays of an archive (only those of `keys` that it has, if given)."""
    if not path.is_file():
        raise InputError(f"{path} does not exist (or is no file); an .npz archive was expected.")
    with (
        explain_damage(path, "an .npz of plain arrays, without pickled objects"),
        path.open("rb") as file,
        np.load(file, allow_pickle=False) as archive,
    ):
        _check_unpacked_size(archive.zip)
        chosen = [key for key in (keys or archive.files) if key in archive.files]
        arrays = {key: archive[key] for key in chosen}
    return {key: array for key, array in arrays.items() if isinstance(array, np.ndarray)}


def read_pickled_arrays(path: Path, keys: Collection[str]) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Read those of the entries `keys` of a pickled dictionary that it has, as arrays."""
    with explain_damage(path, "a pickled dictionary"):
        content = load_safe_pickle(_read_bytes(path))
        if not isinstance(content, dict):
            raise TypeError(f"it holds a {type(content).__name__}")
    arrays = {}
    for key in keys:
        if key in content:
            with explain_damage(path, f"an array under `{key}`"):
                arrays[key] = array_of(content[key])
    return arrays


def _read_bytes(path: Path) -> bytes:
    """Return the bytes of a file, unless there are more than `MAX_BYTES`."""
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise InputError(
            f"{path} has {size >> 20} MiB; files of more than {MAX_BYTES >> 20} MiB are not read."
        )
    return path.read_bytes()


POSE_FILE_SUFFIXES = frozenset(
    {".npz", ".npy", ".pkl", ".pickle", ".pt", ".pth", ".json", ".joblib", ".p"}
)
"""Endings of files that may hold poses; in a folder only these are read."""


def read_untrusted_file(path: Path) -> Any:
    """Return a file's content; for a folder a dictionary of its files in natural order, by name."""
    if path.is_dir():
        files = [file for file in path.iterdir() if file.suffix.lower() in POSE_FILE_SUFFIXES]
        if not files:
            raise InputError(
                f"{path} is a folder without files ({', '.join(sorted(POSE_FILE_SUFFIXES))}); "
                "expected a file of poses, or a folder with one for each frame or person."
            )
        return {
            file.name: read_untrusted_file(file) for file in sorted(files, key=natural_sort_key)
        }
    if not path.is_file():
        raise InputError(f"{path} does not exist (or is no file).")
    with explain_damage(path, "any file of poses"):
        return _decode(_read_bytes(path), path)


def _decode(data: bytes, path: Path) -> Any:
    """Return the content of the bytes, whatever they are packed in."""
    if not data:
        raise ValueError("it is empty")
    if data.startswith(b"PK"):
        return _decode_zip(data)
    if data.startswith(b"\x93NUMPY"):
        return _decode_npy(data)
    if data.startswith(b"\x1f\x8b") or (data[0] == 0x78 and int.from_bytes(data[:2]) % 31 == 0):
        inflater = zlib.decompressobj(zlib.MAX_WBITS + 32)  # of zlib or gzip
        unpacked = inflater.decompress(data, MAX_BYTES)
        if inflater.unconsumed_tail:
            raise ValueError(f"it unpacks to more than {MAX_BYTES >> 20} MiB")
        return _plain(load_safe_pickle(unpacked), {})
    if data.startswith(b"glTF") or data[:64].lstrip().startswith(b"HIERARCHY"):
        return data  # skeletons, which have their own readers
    if data[:64].lstrip()[:1] in (b"{", b"["):
        try:
            return json.loads(data.decode("utf-8"))
        except (ValueError, RecursionError):
            if path.suffix.lower() == ".json":
                raise
    try:
        return _plain(load_safe_pickle(data), {})  # which may begin with a bracket, too
    except UnsafePickleError:
        raise
    except Exception as cause:
        raise ValueError("it is of no kind that is known") from cause


def _decode_zip(data: bytes) -> Any:
    """Return the content of an .npz, or of a file of torch.save."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        names = archive.namelist()
        if any(name.endswith("data.pkl") for name in names):
            return _plain(load_safe_pickle(data), {})
        _check_unpacked_size(archive)
        arrays = [name for name in names if name.endswith(".npy")]
        return {name.removesuffix(".npy"): _decode_npy(archive.read(name)) for name in arrays}


def _check_unpacked_size(archive: zipfile.ZipFile) -> None:
    """Refuse an archive of more than `MAX_BYTES` by the sizes that it lists."""
    if sum(entry.file_size for entry in archive.infolist()) > MAX_BYTES:
        raise ValueError(f"it unpacks to more than {MAX_BYTES >> 20} MiB")


def _decode_npy(data: bytes) -> Any:
    """Return an array of numbers, or texts as a list; objects are unpickled."""
    stream, header = io.BytesIO(data), np.lib.format
    is_first = header.read_magic(stream) == (1, 0)
    read_header = header.read_array_header_1_0 if is_first else header.read_array_header_2_0
    kind = read_header(stream)[2]
    if kind.hasobject:
        return _plain(load_safe_pickle(data[stream.tell() :]), {})
    if kind.names or kind.subdtype:
        raise ValueError("an array of records")
    array = np.load(io.BytesIO(data), allow_pickle=False)
    return array.tolist() if kind.kind in "US" else array


def _plain(thing: Any, known: dict[int, Any]) -> Any:
    """Return dictionaries, lists and arrays for the content of a pickle, each once.

    `known` holds the results by the ids of their sources, which live as long as the pickle.
    """
    torch: Any = sys.modules.get("torch")
    if thing is None or isinstance(thing, bool | int | float | str):
        return thing
    if id(thing) in known:
        return known[id(thing)]
    match thing:
        case bytes() | bytearray():
            made = bytes(thing).decode("latin1")
        case dict():
            made = {_plain_key(key): _plain(value, known) for key, value in thing.items()}
        case list() | tuple() | set():
            made = [_plain(part, known) for part in thing]
        case np.ndarray() if thing.dtype.hasobject:
            made = _plain(thing.tolist(), {})
        case _ if torch is not None and isinstance(thing, torch.Tensor):
            made = thing.detach().numpy()
        case _:
            made = thing
    known[id(thing)] = made
    return made


def _plain_key(key: Any) -> Any:
    if isinstance(key, bytes):
        return key.decode("latin1")
    return key.item() if isinstance(key, np.generic) else key

"""What a file holds, as dictionaries, lists, numbers, texts and numpy arrays; nothing is run.

Three readers: `read_npz` and `read_pickled_arrays` for files whose keys are known, and
`read_untrusted_file` for files of any container, which is recognised by its first bytes: people
rename files.
"""

import io
import json
import sys
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from capture.image_folder import natural_sort_key
from capture.input_error import InputError
from preprocess.safe_pickle import (
    OLD_TORCH_MAGIC,
    ArrayRecord,
    PickleRecord,
    SparseRecord,
    UnsafePickleError,
    array_of,
    dtype_of,
    element_count,
    load_records,
    load_torch,
)

MAX_BYTES = 1 << 30
"""Largest file, and most bytes of arrays made from one (SMPL with 300 betas: a quarter of it)."""

MAX_ITEMS = 1 << 21
"""Most dictionaries, lists and numbers in one file."""

MAX_DEPTH = 16
"""Deepest nesting of dictionaries and lists."""

MAX_UNPACKED_BYTES = 4 << 30
"""Archives that would unpack to more are refused."""


def read_npz(
    path: Path, keys: tuple[str, ...] | None = None
) -> dict[str, Shaped[np.ndarray, "..."]]:
    """The arrays of an archive (only those of `keys` that it has, if given); never executes any.

    Raises:
        InputError: If the file is missing, damaged, too large, or holds pickled objects under a key
            in `keys`.
    """
    if not path.is_file():
        raise InputError(f"{path} does not exist (or is no file); an .npz archive was expected.")
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > MAX_UNPACKED_BYTES:
            raise InputError(
                f"{path} unpacks to {size >> 20} MiB; more than {MAX_UNPACKED_BYTES >> 20} MiB are "
                "not read."
            )
        with np.load(path, allow_pickle=False) as archive:
            wanted = [key for key in (keys or archive.files) if key in archive.files]
            found = {key: archive[key] for key in wanted}
    except InputError:
        raise
    except Exception as cause:  # numpy reads headers as Python: damaged ones fail in any way
        raise InputError(
            f"{path} is no readable .npz of plain arrays ({cause}). "
            "Is the file complete, and written without pickled objects?"
        ) from cause
    return {key: array for key, array in found.items() if isinstance(array, np.ndarray)}


def read_pickled_arrays(path: Path, keys: Collection[str]) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Those of the entries `keys` of a pickled dictionary that it has, as arrays.

    Raises:
        InputError: If the file is too large, is not a pickle of a dictionary, holds anything that
            would have to be executed, or if a wanted entry is not an array.
    """
    content = explain_failures(path, lambda: load_records(read_limited(path)))
    if not isinstance(content, dict):
        raise InputError(f"{path} holds a {type(content).__name__}; a dictionary was expected.")
    arrays = {}
    for key in keys:
        if key in content:
            try:
                arrays[key] = array_of(content[key])
            except Exception as cause:  # the records hold whatever the file says
                raise InputError(f"`{key}` in {path} is no readable array ({cause}).") from cause
    return arrays


def explain_failures(path: Path, read: Callable[[], Any], kind: str = "pickle") -> Any:
    """What `read` gives, or what is wrong with the file, in words.

    Raises:
        InputError: If the file asks to run something, or `read` fails in any other way.
    """
    try:
        return read()
    except (InputError, PermissionError):  # a command names who may not read what
        raise
    except UnsafePickleError as found:
        raise InputError(
            f"{path} is a pickle that asks to run {found}; it was refused and nothing was run. "
            "A body or pose file holds arrays only: get it from its authors again, or convert it "
            "to .npz."
        ) from None
    except Exception as cause:  # a broken pickle may fail in any way: see the pickle documentation
        if isinstance(cause, ModuleNotFoundError) and cause.name == "torch":
            raise InputError(
                f"{path} holds tensors of PyTorch, which is not installed: pip install "
                "'instant-avatar-stream[learn]'. Or convert it to .npz where PyTorch is: "
                "torch.load, then numpy.savez."
            ) from None
        # a KeyError's text is the byte or name that was not expected, and explains nothing
        why = "it holds something else" if isinstance(cause, KeyError) else cause
        raise InputError(f"{path} is no readable {kind} ({why}). Is the file complete?") from cause


def read_limited(path: Path) -> bytes:
    """The bytes of a file, unless there are more than `MAX_BYTES`.

    Raises:
        InputError: If it is too large.
    """
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise InputError(
            f"{path} has {size >> 20} MiB; pickles of more than {MAX_BYTES >> 20} MiB are not read."
        )
    return path.read_bytes()


POSE_FILE_SUFFIXES = frozenset(
    {".npz", ".npy", ".pkl", ".pickle", ".pt", ".pth", ".json", ".joblib", ".p"}
)
"""Endings of files that may hold poses; in a folder only these are read."""

NON_POSE_SUFFIXES = frozenset(
    {".txt", ".csv", ".md", ".bvh", ".fbx", ".glb", ".obj", ".mp4", ".mov", ".png"}
)
"""Endings of files that people name by mistake."""

UNSUPPORTED_MAGIC = {
    b"BZh": "packed by bzip2; unpack it first",
    b"\xfd7zXZ": "packed by xz; unpack it first",
    b"\x89HDF": "an HDF5 file; of PeopleSnapshot's: python -c \"import h5py, numpy; f = "
    "h5py.File('reconstructed_poses.hdf5'); numpy.savez('poses.npz', **{k: f[k][()] for k in f})\"",
    b"MATLAB": "a .mat of MATLAB; write global_orient, body_pose and transl to an .npz",
    b"glTF": "a mesh; poses were expected",
    b"Kaydara": "an .fbx; poses of SMPL were expected",
}
"""What files begin with that can be no poses, and what they are."""

CHUNK_BYTES = 1 << 20
"""Bytes that are unpacked at a time."""

MAX_FOLDER_FILES = 100_000
"""Most files of a folder that holds one pose file per frame."""


def read_untrusted_file(path: Path) -> Any:
    """What a file holds; for a folder a dictionary of its files in natural order, by their names.

    Raises:
        InputError: If it is missing, damaged, too large, or asks to run something.
    """
    if path.is_dir():
        return _folder(path)
    if not path.is_file():
        raise InputError(f"{path} does not exist (or is no file); a file of poses was expected.")
    if path.suffix.lower() in NON_POSE_SUFFIXES:
        raise InputError(
            f"{path} holds no poses that are read; expected a file ending in "
            f"{', '.join(sorted(POSE_FILE_SUFFIXES))} or .jsonl (docs/formats.md)."
        )
    return explain_failures(path, lambda: _decode(read_limited(path), path), "file of poses")


def _folder(path: Path) -> dict[str, Any]:
    files = sorted(
        (file for file in path.iterdir() if file.suffix.lower() in POSE_FILE_SUFFIXES),
        key=natural_sort_key,
    )
    if not files or len(files) > MAX_FOLDER_FILES:
        endings = ", ".join(sorted(POSE_FILE_SUFFIXES))
        raise InputError(
            f"{path} is a folder with {len(files)} files ({endings}); expected a file of poses, or "
            "a folder with one for each frame or person."
        )
    return {file.name: read_untrusted_file(file) for file in files}


def _decode(data: bytes, path: Path) -> Any:
    """What the bytes hold, whatever they are packed in."""
    if not data:
        raise ValueError("it is empty")
    if data.startswith(b"PK"):
        return _zip(data)
    if data.startswith(b"\x93NUMPY"):
        return _npy(data)
    if data[:1] == b"\x78" and (data[0] * 256 + data[1]) % 31 == 0:
        return load_pickle(_inflate(data, zlib.MAX_WBITS))
    if data.startswith(b"\x1f\x8b"):
        return load_pickle(_inflate(data, 16 + zlib.MAX_WBITS))
    for magic, words in UNSUPPORTED_MAGIC.items():
        if data.startswith(magic):
            raise ValueError(words)
    if data[:64].lstrip()[:1] in (b"{", b"["):
        return _json(data, path)
    return load_pickle(data)


def _json(data: bytes, path: Path) -> Any:
    try:
        return json.loads(data.decode("utf-8"))
    except (ValueError, RecursionError):
        if path.suffix.lower() == ".json":
            raise
        return load_pickle(data)  # a pickle may begin with a bracket, too


def _zip(data: bytes) -> Any:
    """An .npz, or what torch.save writes."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = {entry.filename: entry for entry in archive.infolist()}
        if sum(entry.file_size for entry in entries.values()) > 4 * MAX_BYTES:
            raise ValueError(f"it unpacks to more than {4 * MAX_BYTES >> 20} MiB")
        if not any(name.endswith("data.pkl") for name in entries):
            names = [name for name in entries if name.endswith(".npy")]
            return {name.removesuffix(".npy"): _npy(archive.read(name)) for name in names}
    return load_pickle(data)


def read_npy_header(stream: io.BufferedIOBase) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether columns come first, and type of the array in an .npy.

    Raises:
        Exception: Of any kind, if it is damaged: numpy reads headers as Python.
    """
    header = np.lib.format
    is_first = header.read_magic(stream) == (1, 0)
    return (header.read_array_header_1_0 if is_first else header.read_array_header_2_0)(stream)


def _npy(data: bytes) -> Any:
    """An array of numbers or texts; objects are unpickled."""
    stream = io.BytesIO(data)
    shape, by_columns, kind = read_npy_header(stream)
    if kind.hasobject:
        return load_pickle(data[stream.tell() :])
    if kind.names or kind.subdtype:
        raise ValueError("an array of records")
    numbers = np.frombuffer(data, kind, element_count(shape), stream.tell())
    array = numbers.reshape(shape, order="F" if by_columns else "C")
    if kind.kind in "US":
        return array.item() if array.ndim == 0 else array.tolist()
    return array


def _inflate(data: bytes, bits: int) -> bytes:
    """zlib's and gzip's content; its size is counted before anything of it is kept."""
    size = 0
    for piece in _inflated(data, bits):
        size += len(piece)
        if size > MAX_BYTES:
            raise ValueError(f"it unpacks to more than {MAX_BYTES >> 20} MiB")
    return b"".join(_inflated(data, bits))


def _inflated(data: bytes, bits: int) -> Iterator[bytes]:
    """The content, piece after piece."""
    inflater = zlib.decompressobj(bits)
    for start in range(0, len(data), CHUNK_BYTES):
        packed = data[start : start + CHUNK_BYTES]
        while packed and not inflater.eof:
            yield inflater.decompress(packed, CHUNK_BYTES)
            packed = inflater.unconsumed_tail


def load_pickle(data: bytes) -> Any:
    """What a pickle or PyTorch file holds: dictionaries, lists, numbers, texts and numpy arrays.

    Raises:
        UnsafePickleError: If it names anything that is not in `ALLOWED`.
        Exception: Of any kind, if it is damaged or too large.
    """
    if data.startswith(b"PK") or OLD_TORCH_MAGIC in data[:32]:
        return _Plain().of(load_torch(data))
    return _Plain().of(load_records(data))


class _Plain:
    """Turns records and tensors into plain values, each once, with limits on all of them."""

    def __init__(self) -> None:
        self._items, self._grown_bytes = 0, 0
        self._known: dict[int, Any] = {}
        self._kept: list[Any] = []
        """Things made on the way: their ids must not be used again."""

    def of(self, thing: Any, depth: int = 0) -> Any:
        """The plain value; a thing that was met before has the same value again."""
        if thing is None or isinstance(thing, bool | int | float | str | np.ndarray | np.generic):
            return thing
        if depth > MAX_DEPTH:
            raise ValueError("nested too deeply")
        if id(thing) not in self._known:
            self._count(1)
            self._kept.append(thing)
            self._known[id(thing)] = self._made(thing, depth + 1)
        return self._known[id(thing)]

    def _made(self, thing: Any, depth: int) -> Any:
        match thing:
            case bytes() | bytearray():
                return bytes(thing).decode("latin1")
            case dict():
                self._count(len(thing))
                return {
                    self._key(key, depth): self.of(value, depth) for key, value in thing.items()
                }
            case list() | tuple() | set() | frozenset():
                self._count(len(thing))
                return [self.of(part, depth) for part in thing]
            case ArrayRecord(state=(_, shape, kind, _, raw)) if dtype_of(kind).hasobject:
                parts = [self.of(part, depth) for part in raw]
                self._count(len(parts))
                return parts[0] if shape == () and len(parts) == 1 else parts
            case SparseRecord():
                array = array_of(thing)
                self._count_grown(array.nbytes)
                return array
            case PickleRecord():
                return array_of(thing)
        torch: Any = sys.modules.get("torch")
        if torch is not None and type(thing) in (torch.Tensor, torch.nn.Parameter):
            self._count_grown(element_count(thing.shape) * thing.element_size())  # expand()ed, too
            return thing.detach().numpy()
        raise ValueError(f"a {type(thing).__name__}")

    def _key(self, key: Any, depth: int) -> Any:
        plain = self.of(key, depth)
        if isinstance(plain, np.ndarray | np.generic):
            plain = plain.item()
        return tuple(plain) if isinstance(plain, list) else plain

    def _count(self, more: int) -> None:
        self._items += more
        if self._items > MAX_ITEMS:
            raise ValueError(f"more than {MAX_ITEMS} things")

    def _count_grown(self, more: int) -> None:
        """Counts the bytes of arrays that a small file can make large."""
        self._grown_bytes += more
        if self._grown_bytes > MAX_BYTES:
            raise ValueError(f"arrays that grow beyond {MAX_BYTES >> 20} MiB")

"""Read pickles and PyTorch files of other people without running what is in them.

A pickle is a program. Here it may name only what `ALLOWED` lists, and each of these names stands
for a record that keeps its arguments, or for a function that returns a plain value: no class of
numpy, scipy, chumpy or joblib is ever called. Arrays are made of the records afterwards, within
limits on their size. PyTorch's files are read by `torch.load(weights_only=True)`.
"""

import io
import pickle
import re
import struct
import sys
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np
from jaxtyping import Shaped

from capture.input_error import InputError
from preprocess.pickle_records import (
    ArrayRecord,
    ChumpyRecord,
    DTypeRecord,
    JoblibArrayRecord,
    NameRecord,
    PickleRecord,
    SparseRecord,
    array_of,
    dtype_of,
    element_count,
    shaped_array,
)

MAX_BYTES = 1 << 30
"""Largest file, and most bytes of arrays made from one (SMPL with 300 betas: a quarter of it)."""

MAX_ITEMS = 1 << 21
"""Most dictionaries, lists and numbers in one file."""

MAX_DEPTH = 16
"""Deepest nesting of dictionaries and lists."""

MAX_NESTED_PICKLES = 2
"""Deepest nesting of pickles in joblib's arrays of objects."""

OLD_TORCH_MAGIC = b"\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19."
"""Number at the start of PyTorch's files before 1.6, as an opcode of a pickle."""


class UnsafePickleError(Exception):
    """The pickle names something that is not in `ALLOWED`."""


def _latin1(text: str, *_: Any) -> bytes:
    """How Python 3 writes bytes for Python 2: `_codecs.encode(text, "latin1")`."""
    return text.encode("latin1")


def _no_bytes() -> bytes:
    """How Python 3 writes b"" for Python 2."""
    return b""


def _dict(*arguments: Any) -> dict[Any, Any]:
    """defaultdict or OrderedDict; Python 2's brings its pairs along."""
    return dict(arguments[0]) if arguments and isinstance(arguments[0], list) else {}


def _new(kind: Any, *_: Any) -> PickleRecord:
    """An empty record: `copyreg._reconstructor(kind, object, None)`."""
    if not (isinstance(kind, type) and issubclass(kind, PickleRecord)):
        raise pickle.UnpicklingError("an object of an unknown kind")
    return kind()


def _torch_storage(raw: bytes | str) -> Any:
    """The numbers of a tensor in a pickle, which are a file of PyTorch themselves."""
    return _load_torch(raw.encode("latin1") if isinstance(raw, str) else raw)


def _tensor(
    storage: Any, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: Any
) -> Any:
    """A view of a storage; it may not reach beyond it, for PyTorch would enlarge it then."""
    import torch
    import torch._utils

    if not isinstance(storage, torch.storage.TypedStorage) or len(size) != len(stride):
        raise ValueError("a tensor without its numbers")
    if min((offset, *size, *stride)) < 0:
        raise ValueError(f"a tensor of {size} with steps of {stride}")
    last = offset + sum((side - 1) * step for side, step in zip(size, stride, strict=True))
    if element_count(size) and last >= storage._size():
        raise ValueError("a tensor that reaches beyond its storage")
    return torch._utils._rebuild_tensor(storage, offset, size, stride)


ALLOWED: dict[tuple[str, str], Callable[..., Any]] = {
    ("numpy", "ndarray"): NameRecord,
    ("numpy", "dtype"): DTypeRecord,
    **{
        (f"numpy.{core}.{module}", name): ArrayRecord
        for core in ("core", "_core")
        for module, name in (
            ("multiarray", "_reconstruct"), ("multiarray", "scalar"), ("numeric", "_frombuffer"),
        )
    },
    ("joblib.numpy_pickle", "NumpyArrayWrapper"): JoblibArrayRecord,
    ("chumpy.ch", "Ch"): ChumpyRecord,
    ("chumpy.reordering", "Select"): ChumpyRecord,
    ("chumpy.reordering", "transpose"): ChumpyRecord,
    ("scipy.sparse.csc", "csc_matrix"): SparseRecord,
    ("scipy.sparse._csc", "csc_matrix"): SparseRecord,
    ("torch.storage", "_load_from_bytes"): _torch_storage,
    ("torch._utils", "_rebuild_tensor_v2"): _tensor,
    ("torch._utils", "_rebuild_parameter"): lambda tensor, *_: tensor,
    ("_codecs", "encode"): _latin1,
    ("collections", "OrderedDict"): _dict,
    ("collections", "defaultdict"): _dict,
    ("copy_reg", "_reconstructor"): _new,
    ("copyreg", "_reconstructor"): _new,
    **{
        (module, name): stands
        for module in ("__builtin__", "builtins")
        for name, stands in (
            ("object", NameRecord), ("dict", NameRecord), ("set", set), ("bytes", _no_bytes),
        )
    },
}  # fmt: skip
"""All that a pickle may name, by exact module and name, and what is called instead."""

_PythonUnpickler: Any = pickle._Unpickler  # type: ignore[attr-defined]


@final
class _SafeUnpickler(_PythonUnpickler):
    """Python's own unpickler in Python, which imports nothing.

    The one in C would allocate a memo as long as the file claims, and cannot be told where joblib's
    arrays lie between the opcodes.
    """

    dispatch: ClassVar[dict[int, Any]] = dict(_PythonUnpickler.dispatch)

    def __init__(self, stream: io.BytesIO, *, depth: int = 0) -> None:
        """Reads from `stream`; `depth` counts the pickles around this one."""
        super().__init__(stream, encoding="latin1")
        self._stream, self._depth = stream, depth

    def find_class(self, module_name: str, global_name: str) -> Callable[..., Any]:
        """What stands for a name; nothing is ever imported."""
        allowed = ALLOWED.get((module_name, global_name))
        if allowed is None:
            raise UnsafePickleError(f"{module_name}.{global_name}")
        return allowed

    def _build(self) -> None:
        """Keeps the state of a record, and gives no other thing one."""
        state = self.stack.pop()
        record = self.stack[-1]
        if isinstance(record, JoblibArrayRecord):
            self.stack[-1] = self._joblib_array(state)
        elif isinstance(record, PickleRecord):
            record.state = state
        elif not isinstance(record, dict):  # its attributes mean nothing here
            raise pickle.UnpicklingError("a state for something that has none")

    def _bytearray8(self) -> None:
        (length,) = struct.unpack("<Q", self.read(8))
        self._check_remaining(length)
        self.append(bytearray(self.read(length)))

    dispatch[pickle.BUILD[0]] = _build
    dispatch[pickle.BYTEARRAY8[0]] = _bytearray8

    def _joblib_array(self, state: dict[str, Any]) -> Any:
        """joblib's array, whose numbers lie behind the opcodes."""
        kind, shape = dtype_of(state["dtype"]), tuple(int(n) for n in state["shape"])
        if kind.hasobject:
            if self._depth >= MAX_NESTED_PICKLES:
                raise pickle.UnpicklingError("pickles nested too deeply")
            return _SafeUnpickler(self._stream, depth=self._depth + 1).load()
        if state.get("numpy_array_alignment_bytes") is not None:
            self._stream.read(self._stream.read(1)[0])
        length = element_count(shape) * kind.itemsize
        self._check_remaining(length)
        return shaped_array(self._stream.read(length), kind, shape, state["order"])

    def _check_remaining(self, length: int) -> None:
        if not 0 <= length <= len(self._stream.getbuffer()):
            raise pickle.UnpicklingError(f"an array of {length} bytes that are not there")


def load_pickle(data: bytes) -> Any:
    """What a pickle or PyTorch file holds: dictionaries, lists, numbers, texts and numpy arrays.

    Raises:
        UnsafePickleError: If it names anything that is not in `ALLOWED`.
        Exception: Of any kind, if it is damaged or too large.
    """
    if data.startswith(b"PK") or OLD_TORCH_MAGIC in data[:32]:
        return _Plain().of(_load_torch(data))
    return _Plain().of(_load_records(data))


def _load_torch(data: bytes) -> Any:
    """What `torch.load` makes of a file that may name nothing but tensors.

    Raises:
        ModuleNotFoundError: If PyTorch is not installed.
        UnsafePickleError: If it names anything else.
        Exception: Of any kind, if it is damaged.
    """
    import torch

    try:
        return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as cause:  # its words advise to trust the file
        named = re.search(r"GLOBAL (\S+)", str(cause))
        if named is None:
            raise ValueError("PyTorch cannot read it") from cause
        if named[1].startswith("numpy."):
            raise ValueError(
                "it holds numpy's objects; save tensors, or use numpy.savez"
            ) from cause
        raise UnsafePickleError(named[1]) from cause


def read_pickled_arrays(path: Path, keys: Collection[str]) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Those of the entries `keys` of a pickled dictionary that it has, as arrays.

    Raises:
        InputError: If the file is too large, is not a pickle of a dictionary, holds anything that
            would have to be executed, or if a wanted entry is not an array.
    """
    content = explain_failures(path, lambda: _load_records(read_limited(path)))
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


def _load_records(data: bytes) -> Any:
    """What a pickle holds in dictionaries, lists and records."""
    return _SafeUnpickler(io.BytesIO(data)).load()


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

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
from collections.abc import Callable
from typing import Any, ClassVar, final

import numpy as np
from jaxtyping import Shaped

MAX_EXPRESSION_DEPTH = 8
"""Deepest nesting of chumpy's expressions."""

MAX_SPARSE_CELLS = 1 << 25
"""Most numbers in a sparse matrix that is made dense."""

MAX_NESTED_PICKLES = 2
"""Deepest nesting of pickles in joblib's arrays of objects."""

OLD_TORCH_MAGIC = b"\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19."
"""Number at the start of PyTorch's files before 1.6, as an opcode of a pickle."""


class UnsafePickleError(Exception):
    """The pickle names something that is not in `ALLOWED`."""


class PickleRecord:
    """Stands for an object of the pickle: keeps its arguments and its state, runs nothing."""

    arguments: tuple[Any, ...]
    state: Any

    def __new__(cls, *arguments: Any) -> "PickleRecord":
        """A record without a state."""
        record = object.__new__(cls)
        record.arguments, record.state = arguments, None
        return record

    def __init__(self, *arguments: Any) -> None:
        """Does nothing: `pickle` may call `__new__` alone, which keeps the arguments."""


class NameRecord(PickleRecord):
    """A class that is only ever an argument."""


class DTypeRecord(PickleRecord):
    """numpy.dtype(code, …), with the byte order in its state."""


class ArrayRecord(PickleRecord):
    """An array of numpy: contents in its state (`_reconstruct`) or its arguments."""


class JoblibArrayRecord(PickleRecord):
    """joblib's NumpyArrayWrapper: type and shape in its state, contents behind it in the file."""


class ChumpyRecord(PickleRecord):
    """chumpy's variable (`x`), selection (`a`, `idxs`) or transposition (`a`, `axes`)."""


class SparseRecord(PickleRecord):
    """scipy's csc_matrix."""


def array_of(thing: Any, depth: int = 0) -> Shaped[np.ndarray, "..."]:
    """The array that a record, a number or a list of numbers stands for.

    Raises:
        Exception: Of any kind, for the records hold whatever the file says.
    """
    if depth > MAX_EXPRESSION_DEPTH:
        raise ValueError("nested too deeply")
    match thing:
        case np.ndarray():
            return thing
        case ArrayRecord(state=(_, shape, kind, by_columns, raw)):  # _reconstruct
            return shaped_array(raw, dtype_of(kind), shape, "F" if by_columns else "C")
        case ArrayRecord(arguments=(kind, raw)):  # scalar
            return shaped_array(raw, dtype_of(kind), (), "C")
        case ArrayRecord(arguments=(raw, kind, shape, order)):  # _frombuffer
            return shaped_array(raw, dtype_of(kind), shape, order)
        case ChumpyRecord(state={"x": leaf}):
            return array_of(leaf, depth + 1)
        case ChumpyRecord(state={"a": a, "idxs": rows, **others}):
            chosen = array_of(a, depth + 1).ravel()[array_of(rows, depth + 1).ravel()]
            shape = others.get("preferred_shape")
            return chosen if shape is None else chosen.reshape(shape)
        case ChumpyRecord(state={"a": a, **others}):
            return np.transpose(array_of(a, depth + 1), others.get("axes"))
        case SparseRecord():
            return _dense(thing.state, depth)
        case bool() | int() | float() | list() | tuple():
            plain = np.asarray(thing)
            if plain.dtype.kind in "biuf":
                return plain
    raise ValueError(f"a {type(thing).__name__}")


def dtype_of(kind: Any) -> np.dtype:
    """The type that a record stands for; numbers and "object" only."""
    if not isinstance(kind, DTypeRecord):
        raise ValueError("an array without a type")
    code = str(kind.arguments[0])
    if not re.fullmatch(r"[fiu][1248]|b1|O8?", code):
        raise ValueError(f"an array of {code!r}")
    order = kind.state[1] if kind.state else "="
    return np.dtype(code[:2]).newbyteorder(order if order in "<>" else "=")


def shaped_array(raw: Any, kind: np.dtype, shape: Any, order: Any) -> Shaped[np.ndarray, "..."]:
    """Bytes as an array of numbers; a view, which cannot grow."""
    if kind.hasobject:
        raise ValueError("an array of objects")
    content = np.frombuffer(raw.encode("latin1") if isinstance(raw, str) else raw, kind)
    return content.reshape(shape, order="F" if order == "F" else "C")


def _dense(state: Any, depth: int) -> Shaped[np.ndarray, "rows columns"]:
    """scipy's compressed columns as a full matrix."""
    rows, columns = (int(array_of(n)) for n in state.get("_shape", state.get("shape")))
    if rows * columns > MAX_SPARSE_CELLS:
        raise ValueError(f"a sparse matrix of {rows}x{columns}")
    data, indices, starts = (
        array_of(state[key], depth + 1) for key in ("data", "indices", "indptr")
    )
    dense = np.zeros((rows, columns), data.dtype)
    np.add.at(dense, (indices, np.repeat(np.arange(columns), np.diff(starts))), data)
    return dense


def element_count(shape: tuple[int, ...]) -> int:
    """How many numbers an array of this shape holds.

    Raises:
        ValueError: If a side is negative, or that is more than any file can hold.
    """
    if min(shape, default=0) < 0 or len(shape) > 32:
        raise ValueError(f"an array of {shape}")
    count = 1
    for side in shape:
        count *= int(side)
        if count > 1 << 50:
            raise ValueError("an array larger than any file")
    return count


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
    return load_torch(raw.encode("latin1") if isinstance(raw, str) else raw)


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


def load_torch(data: bytes) -> Any:
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


def load_records(data: bytes) -> Any:
    """What a pickle holds in dictionaries, lists and records."""
    return _SafeUnpickler(io.BytesIO(data)).load()

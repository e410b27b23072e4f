"""What stands for the things a pickle names: inert records that keep what they are given.

A pickle is a program. Here it may name a short list of things, each of which is replaced by a
record that does nothing: no class of numpy, scipy, chumpy, joblib or torch is ever called. Only
afterwards are arrays made of them, with limits on how large these may become.
"""

import pickle
import re
from typing import Any

import numpy as np
from jaxtyping import Shaped

MAX_CELLS = 1 << 25
"""Arrays that would grow beyond this many numbers although the file holds fewer are refused."""

MAX_NESTING = 8
"""How deep an expression of arrays may be."""


class Inert:
    """Stands for an object of the pickle: keeps arguments and state, runs nothing."""

    arguments: tuple[Any, ...]
    state: Any

    def __new__(cls, *arguments: Any) -> "Inert":
        """An empty record, whatever the arguments."""
        record = object.__new__(cls)
        record.arguments = arguments
        record.state = None
        return record

    def __init__(self, *arguments: Any) -> None:
        """Arguments are kept by `__new__`, which `pickle` calls even where it skips this."""

    def __setstate__(self, state: Any) -> None:
        """Keeps the state."""
        self.state = state


class Mapping(dict[Any, Any]):
    """defaultdict and OrderedDict: a dictionary that forgets what it was made with."""

    def __new__(cls, *arguments: Any) -> "Mapping":
        """An empty one."""
        return dict.__new__(cls)

    def __init__(self, *arguments: Any) -> None:
        """Python 2's OrderedDict brings its pairs along."""
        pairs = arguments[0] if arguments else None
        super().__init__(pairs if isinstance(pairs, list) else ())

    def __setstate__(self, state: Any) -> None:
        """Attributes of a dictionary mean nothing here."""


class DataType(Inert):
    """numpy.dtype(code, …), byte order in the state."""


class Named(Inert):
    """A class that is only ever named as an argument."""


class Array(Inert):
    """numpy's _reconstruct: contents in the state."""


class BufferArray(Inert):
    """numpy's _frombuffer (pickle protocol 5): contents in the arguments."""


class WrappedArray(Inert):
    """joblib's NumpyArrayWrapper: type and shape in the state, contents behind it in the file."""

    content: Any = None


class Scalar(Inert):
    """numpy's scalar(dtype, bytes)."""


class Variable(Inert):
    """chumpy.ch.Ch: a leaf `x`."""


class ChumpySelect(Inert):
    """chumpy.reordering.Select: `a[idxs]`."""


class Transposition(Inert):
    """chumpy.reordering.transpose: `a` with its `axes` permuted."""


class SparseColumns(Inert):
    """scipy's csc_matrix."""


class Encoded(Inert):
    """_codecs.encode(text, "latin1"): how Python 3 writes bytes for Python 2."""


class Nothing(Inert):
    """bytes(): how Python 3 writes b"" for Python 2, as in an array without rows."""

    def __new__(cls, *arguments: Any) -> Any:
        """The empty bytes themselves."""
        if arguments:
            raise pickle.UnpicklingError("bytes made of something")
        return b""


class Tensor(Inert):
    """torch's _rebuild_tensor_v2(storage, offset, size, stride, …)."""


class Parameter(Inert):
    """torch's _rebuild_parameter(tensor, …)."""


class Storage(Inert):
    """The numbers of torch's tensors: name of the type, and the numbers once they were found."""

    content: Shaped[np.ndarray, "numbers"] | None = None


class StoredBytes(Inert):
    """torch.storage._load_from_bytes(bytes): a storage in torch's old file format."""


class Reconstructed(Inert):
    """copyreg._reconstructor(class, object, None): makes an empty inert record."""

    def __new__(cls, *arguments: Any) -> Inert:
        """A record of the class that is named."""
        kind = arguments[0]
        if not (isinstance(kind, type) and issubclass(kind, Inert)):
            raise pickle.UnpicklingError("an object of an unknown kind")
        return Inert.__new__(kind)


STORAGES = {
    "FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2", "LongStorage": "<i8",
    "IntStorage": "<i4", "ShortStorage": "<i2", "CharStorage": "<i1", "ByteStorage": "<u1",
    "BoolStorage": "|b1",
}  # fmt: skip
"""torch's kinds of storage and numpy's names of their numbers."""

STORAGE_KINDS = {name: type(name, (Named,), {"number": code}) for name, code in STORAGES.items()}

ALLOWED: dict[tuple[str, str], type] = {
    ("numpy", "ndarray"): Named,
    ("numpy", "dtype"): DataType,
    **{
        (f"{module}.{file}", name): kind
        for module in ("numpy.core", "numpy._core")
        for file, name, kind in (
            ("multiarray", "_reconstruct", Array),
            ("multiarray", "scalar", Scalar),
            ("numeric", "_frombuffer", BufferArray),
        )
    },
    ("joblib.numpy_pickle", "NumpyArrayWrapper"): WrappedArray,
    ("chumpy.ch", "Ch"): Variable,
    ("chumpy.reordering", "Select"): ChumpySelect,
    ("chumpy.reordering", "transpose"): Transposition,
    ("scipy.sparse.csc", "csc_matrix"): SparseColumns,
    ("scipy.sparse._csc", "csc_matrix"): SparseColumns,
    ("torch._utils", "_rebuild_tensor_v2"): Tensor,
    ("torch._utils", "_rebuild_parameter"): Parameter,
    ("torch.storage", "_load_from_bytes"): StoredBytes,
    **{("torch", name): kind for name, kind in STORAGE_KINDS.items()},
    ("_codecs", "encode"): Encoded,
    **{
        (module, name): kind
        for modules, name, kind in (
            (("copy_reg", "copyreg"), "_reconstructor", Reconstructed),
            (("__builtin__", "builtins"), "object", Named),
            (("__builtin__", "builtins"), "dict", Named),
            (("__builtin__", "builtins"), "set", set),
            (("__builtin__", "builtins"), "bytes", Nothing),
        )
        for module in modules
    },
    ("collections", "OrderedDict"): Mapping,
    ("collections", "defaultdict"): Mapping,
}
"""All that a pickle may name, by exact module and name, and what stands for it here."""


def array_of(thing: Any, nesting: int = 0) -> Shaped[np.ndarray, "..."]:
    """The array that a record, a number or a list of numbers stands for.

    Raises:
        Exception: Of any kind, for the records hold whatever the file says.
    """
    if nesting > MAX_NESTING:
        raise ValueError("nested too deeply")
    match thing:
        case np.ndarray():
            return thing
        case Array():
            _, shape, kind, by_columns, raw = thing.state
            return _array(raw, dtype_of(kind), shape, "F" if by_columns else "C")
        case BufferArray():
            raw, kind, shape, order = thing.arguments
            return _array(raw, dtype_of(kind), shape, order)
        case WrappedArray() if isinstance(thing.content, np.ndarray):
            return thing.content
        case Scalar():
            kind, raw = thing.arguments
            return np.frombuffer(_bytes_of(raw), dtype_of(kind), 1).reshape(())
        case Tensor():
            return _tensor(*thing.arguments[:4])
        case Parameter():
            return array_of(thing.arguments[0], nesting + 1)
        case Variable():
            return array_of(thing.state["x"], nesting + 1)
        case ChumpySelect():
            chosen = array_of(thing.state["a"], nesting + 1).ravel()[
                array_of(thing.state["idxs"], nesting + 1).ravel()
            ]
            shape = thing.state.get("preferred_shape")
            return chosen if shape is None else chosen.reshape(shape)
        case Transposition():
            return np.transpose(array_of(thing.state["a"], nesting + 1), thing.state.get("axes"))
        case SparseColumns():
            return _dense(thing.state, nesting)
        case bool() | int() | float() | list() | tuple():
            plain = np.asarray(thing)
            if plain.dtype.kind in "biuf":
                return plain
    raise ValueError(f"a {type(thing).__name__}")


def dtype_of(kind: Any) -> np.dtype:
    """The type that a record stands for; numbers and "object" only.

    Raises:
        ValueError: If it is another.
    """
    if not isinstance(kind, DataType):
        raise ValueError("an array without a type")
    code = str(kind.arguments[0])
    if not re.fullmatch(r"[fiu][1248]|b1|O8?", code):
        raise ValueError(f"an array of {code!r}")
    order = kind.state[1] if kind.state else "="
    return np.dtype(code[:2]).newbyteorder(order if order in "<>" else "=")


def product(shape: tuple[int, ...]) -> int:
    """How many numbers an array of this shape holds.

    Raises:
        ValueError: If that is more than any file can hold.
    """
    cells = 1
    for side in shape:
        cells *= min(int(side), 1 << 40)
        if cells > 1 << 50 or len(shape) > 32:
            raise ValueError("an array larger than any file")
    return cells


def _array(
    raw: Any, kind: np.dtype, shape: tuple[int, ...], order: str
) -> Shaped[np.ndarray, "..."]:
    if kind.hasobject:
        raise ValueError("an array of objects")
    content = np.frombuffer(_bytes_of(raw), kind)
    return content.reshape(shape, order="F" if order == "F" else "C")


def _bytes_of(raw: Any) -> bytes | bytearray:
    if isinstance(raw, Encoded):
        raw = raw.arguments[0]
    return raw.encode("latin1") if isinstance(raw, str) else raw


def _tensor(
    storage: Any, offset: int, size: tuple[int, ...], stride: tuple[int, ...]
) -> Shaped[np.ndarray, "..."]:
    """A strided view of a storage that cannot be written; it may not reach beyond its numbers."""
    if not isinstance(storage, Storage) or storage.content is None:
        raise ValueError("a tensor without its numbers")
    numbers = storage.content
    if len(size) != len(stride) or min((offset, *size, *stride), default=0) < 0:
        raise ValueError(f"a tensor of {size} with steps of {stride}")
    cells = product(size)
    if cells > MAX_CELLS:
        raise ValueError(f"a tensor of {size}")
    last = offset + sum((side - 1) * step for side, step in zip(size, stride, strict=True))
    if cells and last >= len(numbers):
        raise ValueError("a tensor that reaches beyond its storage")
    if not cells:
        return np.zeros(size, numbers.dtype)
    steps = [step * numbers.itemsize for step in stride]
    return np.lib.stride_tricks.as_strided(numbers[offset:], size, steps, writeable=False)


def _dense(state: Any, nesting: int) -> Shaped[np.ndarray, "rows columns"]:
    rows, columns = (int(array_of(n)) for n in state.get("_shape", state.get("shape")))
    if rows * columns > MAX_CELLS:
        raise ValueError(f"a sparse matrix of {rows}x{columns}")
    data, indices, starts = (
        array_of(state[key], nesting + 1) for key in ("data", "indices", "indptr")
    )
    dense = np.zeros((rows, columns), data.dtype)
    np.add.at(dense, (indices, np.repeat(np.arange(columns), np.diff(starts))), data)
    return dense

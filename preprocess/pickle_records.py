"""What stands for the things that a pickle names: records that keep what they are given.

No class of numpy, scipy, chumpy or joblib is called while a pickle is read; `array_of` makes arrays
of the records afterwards, within limits on their size.
"""

import re
from typing import Any

import numpy as np
from jaxtyping import Shaped

MAX_EXPRESSION_DEPTH = 8
"""Deepest nesting of chumpy's expressions."""

MAX_SPARSE_CELLS = 1 << 25
"""Most numbers in a sparse matrix that is made dense."""


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

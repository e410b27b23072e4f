"""Arrays out of pickle files, strangers' and Python 2's too, without executing what they hold.

A pickle is a program. Here it may name a short list of things, each of which is replaced by an
inert record that remembers what it was given and does nothing: no class of numpy, scipy or chumpy
is ever called. Only afterwards the wanted entries are turned into arrays.
"""

import io
import pickle
import pickletools
import re
from collections import OrderedDict
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from capture.errors import BadInput

MAX_BYTES = 1 << 30
"""Larger files are refused (SMPL with 300 betas takes a quarter of it)."""

MAX_CELLS = 1 << 26
"""Sparse matrices that would grow beyond this many numbers are refused."""

MAX_MEMO = 1 << 22
"""Memo numbers beyond this are refused: the unpickler would allocate a table that long."""

MAX_NESTING = 8
"""How deep an expression of arrays may be."""


class _Inert:
    """Stands for an object of the pickle: keeps arguments and state, runs nothing."""

    arguments: tuple[Any, ...]
    state: Any

    def __new__(cls, *arguments: Any) -> "_Inert":
        record = object.__new__(cls)
        record.arguments = arguments
        record.state = None
        return record

    def __init__(self, *arguments: Any) -> None:
        """Arguments are kept by `__new__`, which `pickle` calls even where it skips this."""

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Type(_Inert):
    """numpy.dtype(code, …), byte order in the state."""


class _NdarrayClass(_Inert):
    """The class numpy.ndarray, only ever named as an argument."""


class _Array(_Inert):
    """numpy's _reconstruct: contents in the state."""


class _BufferArray(_Inert):
    """numpy's _frombuffer (pickle protocol 5): contents in the arguments."""


class _Scalar(_Inert):
    """numpy's scalar(dtype, bytes)."""


class _Variable(_Inert):
    """chumpy.ch.Ch: a leaf `x`."""


class _Selection(_Inert):
    """chumpy.reordering.Select: `a[idxs]`."""


class _Transposition(_Inert):
    """chumpy.reordering.transpose: `a` with its `axes` permuted."""


class _SparseColumns(_Inert):
    """scipy's csc_matrix."""


class _Encoded(_Inert):
    """_codecs.encode(text, "latin1"): how Python 3 writes bytes for Python 2."""


class _ObjectClass(_Inert):
    """The class object, only ever named as an argument."""


class _Reconstructed(_Inert):
    """copyreg._reconstructor(class, object, None): makes an empty inert record."""

    def __new__(cls, *arguments: Any) -> _Inert:
        kind = arguments[0]
        if not (isinstance(kind, type) and issubclass(kind, _Inert)):
            raise pickle.UnpicklingError("an object of an unknown kind")
        return _Inert.__new__(kind)


ALLOWED: dict[tuple[str, str], type] = {
    ("numpy", "ndarray"): _NdarrayClass,
    ("numpy", "dtype"): _Type,
    **{
        (f"{module}.{file}", name): kind
        for module in ("numpy.core", "numpy._core")
        for file, name, kind in (
            ("multiarray", "_reconstruct", _Array),
            ("multiarray", "scalar", _Scalar),
            ("numeric", "_frombuffer", _BufferArray),
        )
    },
    ("chumpy.ch", "Ch"): _Variable,
    ("chumpy.reordering", "Select"): _Selection,
    ("chumpy.reordering", "transpose"): _Transposition,
    ("scipy.sparse.csc", "csc_matrix"): _SparseColumns,
    ("scipy.sparse._csc", "csc_matrix"): _SparseColumns,
    ("_codecs", "encode"): _Encoded,
    ("copy_reg", "_reconstructor"): _Reconstructed,
    ("copyreg", "_reconstructor"): _Reconstructed,
    ("__builtin__", "object"): _ObjectClass,
    ("builtins", "object"): _ObjectClass,
    ("__builtin__", "set"): set,
    ("builtins", "set"): set,
    ("collections", "OrderedDict"): OrderedDict,
}
"""All that a pickle may name, by exact module and name, and what stands for it here."""


class _HoldsCode(Exception):  # noqa: N818 - a finding, not a fault of ours
    """The pickle names something that is not on the list."""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module_name: str, global_name: str) -> type:
        """What stands for a global; nothing is ever imported."""
        allowed = ALLOWED.get((module_name, global_name))
        if allowed is None:
            raise _HoldsCode(f"{module_name}.{global_name}")
        return allowed

    def persistent_load(self, pid: Any) -> Any:
        """Objects kept outside the file do not exist here."""
        raise pickle.UnpicklingError("an object outside the file")


def read_pickled_arrays(path: Path, keys: Collection[str]) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Those of the entries `keys` of a pickled dictionary that it has, as arrays.

    Reads plain numpy arrays of Python 2 and 3, chumpy's variables, selections and transpositions,
    and scipy's csc matrices (made dense).

    Raises:
        BadInput: If the file is too large, is no pickle of a dictionary, holds anything that would
            have to be executed, or if a wanted entry is no array.
    """
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise BadInput(
            f"{path} has {size >> 20} MiB; pickles of more than {MAX_BYTES >> 20} MiB are not read."
        )
    data = path.read_bytes()
    try:
        _check_opcodes(data)
        content = _Unpickler(io.BytesIO(data), encoding="latin1").load()
    except _HoldsCode as found:
        raise BadInput(
            f"{path} is a pickle that asks to run {found}; it was refused and nothing was run. "
            "A body or pose file holds arrays only: get it from its authors again, or convert it "
            "to .npz."
        ) from None
    except Exception as cause:  # a broken pickle may fail in any way: see the pickle documentation
        raise BadInput(f"{path} is no readable pickle ({cause}). Is the file complete?") from cause
    if not isinstance(content, dict):
        raise BadInput(f"{path} holds a {type(content).__name__}; a dictionary was expected.")
    arrays = {}
    for key in keys:
        if key in content:
            try:
                arrays[key] = _array_of(content[key])
            except Exception as cause:  # as above: the records hold whatever the file says
                raise BadInput(f"`{key}` in {path} is no readable array ({cause}).") from cause
    return arrays


def _check_opcodes(data: bytes) -> None:
    """Reads the stream without running it, so that no length or number in it can be a bomb."""
    for opcode, argument, _ in pickletools.genops(data):
        if "PUT" in opcode.name and int(argument or 0) > MAX_MEMO:
            raise pickle.UnpicklingError(f"memo number {argument}")


def _array_of(thing: Any, nesting: int = 0) -> Shaped[np.ndarray, "..."]:
    """The array that a record, a number or a list of numbers stands for."""
    if nesting > MAX_NESTING:
        raise ValueError("nested too deeply")
    match thing:
        case _Array():
            _, shape, kind, by_columns, raw = thing.state
            return _array(raw, kind, shape, "F" if by_columns else "C")
        case _BufferArray():
            raw, kind, shape, order = thing.arguments
            return _array(raw, kind, shape, order)
        case _Scalar():
            kind, raw = thing.arguments
            return _array(raw, kind, (), "C")
        case _Variable():
            return _array_of(thing.state["x"], nesting + 1)
        case _Selection():
            chosen = _array_of(thing.state["a"], nesting + 1).ravel()[
                _array_of(thing.state["idxs"], nesting + 1).ravel()
            ]
            shape = thing.state.get("preferred_shape")
            return chosen if shape is None else chosen.reshape(shape)
        case _Transposition():
            return np.transpose(_array_of(thing.state["a"], nesting + 1), thing.state.get("axes"))
        case _SparseColumns():
            return _dense(thing.state, nesting)
        case bool() | int() | float() | list() | tuple():
            plain = np.asarray(thing)
            if plain.dtype.kind in "biuf":
                return plain
    raise ValueError(f"a {type(thing).__name__.lstrip('_')}")


def _array(raw: Any, kind: Any, shape: tuple[int, ...], order: str) -> Shaped[np.ndarray, "..."]:
    content = np.frombuffer(_bytes_of(raw), _dtype_of(kind))
    return content.reshape(shape, order="F" if order == "F" else "C")


def _bytes_of(raw: Any) -> bytes | bytearray:
    if isinstance(raw, _Encoded):
        raw = raw.arguments[0]
    return raw.encode("latin1") if isinstance(raw, str) else raw


def _dtype_of(kind: Any) -> np.dtype:
    if not isinstance(kind, _Type):
        raise ValueError("an array without a type")
    code = str(kind.arguments[0])
    if not re.fullmatch(r"[fiu][1248]|b1", code):
        raise ValueError(f"an array of {code!r}")
    order = kind.state[1] if kind.state else "="
    return np.dtype(code).newbyteorder(order if order in "<>" else "=")


def _dense(state: Any, nesting: int) -> Shaped[np.ndarray, "rows columns"]:
    rows, columns = (int(_array_of(n)) for n in state.get("_shape", state.get("shape")))
    if rows * columns > MAX_CELLS:
        raise ValueError(f"a sparse matrix of {rows}x{columns}")
    data, indices, starts = (
        _array_of(state[key], nesting + 1) for key in ("data", "indices", "indptr")
    )
    dense = np.zeros((rows, columns), data.dtype)
    np.add.at(dense, (indices, np.repeat(np.arange(columns), np.diff(starts))), data)
    return dense

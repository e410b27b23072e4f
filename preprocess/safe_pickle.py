"""Read pickles and PyTorch files of other people without running what is in them.

A pickle is a program. Here it may name only what `ALLOWED` lists: plain containers, functions that
return plain arrays, and stand-ins that keep what they are given. No class of another library is
ever called, but PyTorch's tensors; its own files are read by `torch.load(weights_only=True)`.
"""

import io
import math
import pickle
import re
from collections.abc import Callable
from typing import Any, ClassVar, final

import numpy as np
from jaxtyping import Shaped


class UnsafePickleError(Exception):
    """The pickle names something that is not in `ALLOWED`."""


class StandIn:
    """Stands for an object of another library: keeps its arguments and its state."""

    arguments: tuple[Any, ...] = ()
    state: Any = None

    def __init__(self, *arguments: Any) -> None:
        """Keep the arguments."""
        self.arguments = arguments


class DTypeStandIn(StandIn):
    """numpy.dtype(code, …), with the byte order in its state."""

    @property
    def dtype(self) -> np.dtype:
        """The type; numbers and "object" only."""
        code = str(self.arguments[0])
        if not re.fullmatch(r"[fiu][1248]|b1|O8?", code):
            raise ValueError(f"an array of {code!r}")
        order = self.state[1] if self.state else "="
        return np.dtype(code[:2]).newbyteorder(order if order in "<>" else "=")


class JoblibArray(StandIn):
    """joblib's NumpyArrayWrapper: type and shape in its state, contents behind it in the file."""


class ChumpyExpression(StandIn):
    """chumpy's variable (`x`), selection (`a`, `idxs`) or transposition (`a`, `axes`)."""


class SparseColumns(StandIn):
    """scipy's csc_matrix."""


def array_of(thing: Any) -> Shaped[np.ndarray, "..."]:
    """Return the array that a stand-in, a number or a list of numbers stands for.

    Any exception may be raised: stand-ins hold whatever the file says.
    """
    match thing:
        case np.ndarray() if not thing.dtype.hasobject:
            return thing
        case ChumpyExpression(state={"x": leaf}):
            return array_of(leaf)
        case ChumpyExpression(state={"a": a, "idxs": rows, **others}):
            chosen = array_of(a).ravel()[array_of(rows).ravel()]
            shape = others.get("preferred_shape")
            return chosen if shape is None else chosen.reshape(shape)
        case ChumpyExpression(state={"a": a, **others}):
            return np.transpose(array_of(a), others.get("axes"))
        case SparseColumns(state={"data": data, "indices": rows, "indptr": starts, **others}):
            height, width = others["_shape" if "_shape" in others else "shape"]
            dense = np.zeros((height, width), data.dtype)
            columns = np.repeat(np.arange(width), np.diff(starts))
            np.add.at(dense, (rows, columns), data)
            return dense
        case bool() | int() | float() | np.generic() | list() | tuple():
            plain = np.asarray(thing)
            if plain.dtype.kind in "biuf":
                return plain
    raise ValueError(f"a {type(thing).__name__}")


def _frombuffer(raw: Any, kind: DTypeStandIn, shape: Any, order: Any) -> Shaped[np.ndarray, "..."]:
    content = np.frombuffer(_as_bytes(raw), kind.dtype)
    return content.reshape(shape, order="F" if order == "F" else "C")


def _as_bytes(raw: Any) -> Any:
    """Return bytes of a pickle, which those of Python 2 and joblib hold as text."""
    return raw.encode("latin1") if isinstance(raw, str) else raw


def _fill_array(array: Shaped[np.ndarray, "..."], state: Any) -> None:
    _, shape, kind, by_columns, raw = state
    if min(shape, default=0) < 0 or (kind.dtype.hasobject and math.prod(shape) != len(raw)):
        raise ValueError(f"an array of {shape}")  # which numpy would not check
    own: Any = 1, shape, kind.dtype, bool(by_columns), _as_bytes(raw)
    array.__setstate__(own)


def _dict(*arguments: Any) -> dict[Any, Any]:
    """Return a defaultdict or OrderedDict as a dictionary; Python 2's brings its pairs along."""
    return dict(arguments[0]) if arguments and isinstance(arguments[0], list) else {}


def _new(kind: Any, *_: Any) -> StandIn:
    """Return an empty stand-in: `copyreg._reconstructor(kind, object, None)`."""
    if not (isinstance(kind, type) and issubclass(kind, StandIn)):
        raise pickle.UnpicklingError("an object of an unknown kind")
    return kind()


def _tensor(*arguments: Any) -> Any:
    import torch._utils

    return torch._utils._rebuild_tensor_v2(*arguments)


ALLOWED: dict[tuple[str, str], Callable[..., Any]] = {
    ("numpy", "ndarray"): object,
    ("numpy", "dtype"): DTypeStandIn,
    **{
        (f"numpy.{core}.{module}", name): function
        for core in ("core", "_core")
        for module, name, function in (
            ("multiarray", "_reconstruct", lambda *_: np.empty(0)),
            ("multiarray", "scalar", lambda kind, raw: _frombuffer(raw, kind, (), "C")[()]),
            ("numeric", "_frombuffer", _frombuffer),
        )
    },
    ("joblib.numpy_pickle", "NumpyArrayWrapper"): JoblibArray,
    ("chumpy.ch", "Ch"): ChumpyExpression,
    ("chumpy.reordering", "Select"): ChumpyExpression,
    ("chumpy.reordering", "transpose"): ChumpyExpression,
    ("scipy.sparse.csc", "csc_matrix"): SparseColumns,
    ("scipy.sparse._csc", "csc_matrix"): SparseColumns,
    ("torch.storage", "_load_from_bytes"): lambda raw: load_torch(_as_bytes(raw)),
    ("torch._utils", "_rebuild_tensor_v2"): _tensor,
    ("torch._utils", "_rebuild_parameter"): lambda tensor, *_: tensor,
    ("_codecs", "encode"): lambda text, *_: text.encode("latin1"),
    ("collections", "OrderedDict"): _dict,
    ("collections", "defaultdict"): _dict,
    ("copy_reg", "_reconstructor"): _new,
    ("copyreg", "_reconstructor"): _new,
    **{
        (module, name): function
        for module in ("__builtin__", "builtins")
        for name, function in (
            ("object", object), ("dict", dict), ("set", set), ("bytes", lambda *_: b""),
        )
    },
}  # fmt: skip
"""All that a pickle may name, by exact module and name, and what is called instead."""
_PythonUnpickler: Any = pickle._Unpickler  # type: ignore[attr-defined]


@final
class _SafeUnpickler(_PythonUnpickler):
    """Python's own unpickler, which imports nothing, and reads joblib's arrays between opcodes."""

    dispatch: ClassVar[dict[int, Any]] = dict(_PythonUnpickler.dispatch)

    def __init__(self, stream: io.BytesIO) -> None:
        """Read from a stream."""
        super().__init__(stream, encoding="latin1")
        self._stream = stream

    def find_class(self, module_name: str, global_name: str) -> Callable[..., Any]:
        """Return the stand-in for a name; nothing is ever imported."""
        allowed = ALLOWED.get((module_name, global_name))
        if allowed is None:
            raise UnsafePickleError(f"{module_name}.{global_name}")
        return allowed

    def _build(self) -> None:
        """Give arrays and stand-ins their state, and no other thing one."""
        state, thing = self.stack.pop(), self.stack[-1]
        if isinstance(thing, JoblibArray):
            self.stack[-1] = self._joblib_array(state)
        elif isinstance(thing, np.ndarray):
            _fill_array(thing, state)
        elif isinstance(thing, StandIn):
            thing.state = state
        elif not isinstance(thing, dict):  # its attributes mean nothing here
            raise pickle.UnpicklingError("a state for something that has none")

    dispatch[pickle.BUILD[0]] = _build

    def _joblib_array(self, state: dict[str, Any]) -> Any:
        """Read joblib's array, whose numbers lie behind the opcodes."""
        kind, shape = state["dtype"], tuple(int(n) for n in state["shape"])
        if kind.dtype.hasobject:
            return _SafeUnpickler(self._stream).load()
        if state.get("numpy_array_alignment_bytes") is not None:
            self._stream.read(self._stream.read(1)[0])
        raw = self._stream.read(max(0, math.prod(shape)) * kind.dtype.itemsize)
        return _frombuffer(raw, kind, shape, state["order"])


def load_torch(data: bytes) -> Any:
    """Return the result of `torch.load` for a file that may name nothing but tensors."""
    import torch

    try:
        return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as cause:  # its words advise to trust the file
        name = re.search(r"GLOBAL (\S+)", str(cause))
        if name is None:
            raise ValueError("PyTorch cannot read it") from cause
        raise UnsafePickleError(name[1]) from cause


def load_safe_pickle(data: bytes) -> Any:
    """Return the content of a pickle or PyTorch file: containers, arrays, tensors and stand-ins."""
    old_torch = b"\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19."  # an opcode; PyTorch's mark before 1.6
    if data.startswith(b"PK") or old_torch in data[:32]:
        return load_torch(data)
    return _SafeUnpickler(io.BytesIO(data)).load()

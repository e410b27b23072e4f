"""Unpickling into inert records: joblib's arrays and torch's storages included, nothing is run."""

import io
import pickle
import struct
from collections.abc import Callable
from typing import Any, ClassVar, final

import numpy as np
from jaxtyping import Shaped

from preprocess.pickles.pickle_records import (
    ALLOWED,
    STORAGES,
    Inert,
    Named,
    Storage,
    StoredBytes,
    WrappedArray,
    dtype_of,
    product,
)

MAX_NESTED = 4
"""How many files may be nested in one another (a storage in a tensor in an array in a file)."""

OLD_TORCH = 0x1950A86A20F9469CFC6C
"""With this number begins a file in torch's format before its zip files."""

FetchStorage = Callable[[str, int], bytes]
"""From a storage's name and its length in bytes to its numbers."""


class UnsafePickleError(Exception):
    """The pickle names something that is not on the list."""


_PythonUnpickler: Any = pickle._Unpickler  # type: ignore[attr-defined]


@final
class InertUnpickler(_PythonUnpickler):
    """Python's own unpickler in Python, with a list of names in place of imports.

    It is slower than the one in C; but it keeps numbers of the memo in a dictionary, where the
    other would allocate a table as long as the file says, and it can be told where joblib's arrays
    lie between the opcodes.
    """

    dispatch: ClassVar[dict[int, Any]] = dict(_PythonUnpickler.dispatch)

    def __init__(
        self, stream: io.BytesIO, fetch: FetchStorage | None = None, *, nested: int = 0
    ) -> None:
        """Reads from `stream`; `fetch` finds the storages that lie outside of it."""
        super().__init__(stream, encoding="latin1")
        self._stream, self._fetch, self._nested = stream, fetch, nested
        self._storages: dict[str, Storage] = {}

    def find_class(self, module_name: str, global_name: str) -> type:
        """What stands for a global; nothing is ever imported."""
        allowed = ALLOWED.get((module_name, global_name))
        if allowed is None:
            raise UnsafePickleError(f"{module_name}.{global_name}")
        return allowed

    def persistent_load(self, pid: Any) -> Any:
        """torch's storages; other objects outside the file do not exist here."""
        if self._fetch is None or not isinstance(pid, tuple) or len(pid) < 5:
            raise pickle.UnpicklingError("an object outside the file")
        name, count = str(pid[2]), int(pid[4])
        if name not in self._storages:
            kind = np.dtype(_number_of(pid[1]))
            storage: Any = Storage()
            raw = self._fetch(name, count * kind.itemsize)
            if raw:
                storage.content = np.frombuffer(raw, kind, count)
            storage.state = (kind, count)
            self._storages[name] = storage
        return self._storages[name]

    def _reduce(self) -> None:
        super().load_reduce()
        made = self.stack[-1]
        if isinstance(made, StoredBytes):
            (raw,) = made.arguments
            self.stack[-1] = _old_storage(raw, self._nested + 1)

    def _build(self) -> None:
        super().load_build()
        made = self.stack[-1]
        if isinstance(made, WrappedArray):
            self.stack[-1] = self._wrapped(made.state)

    def _bytearray8(self) -> None:
        (length,) = struct.unpack("<Q", self.read(8))
        if length > len(self._stream.getbuffer()):
            raise pickle.UnpicklingError(f"an array of {length} bytes that are not there")
        self.append(bytearray(self.read(length)))

    dispatch[pickle.REDUCE[0]] = _reduce
    dispatch[pickle.BUILD[0]] = _build
    dispatch[pickle.BYTEARRAY8[0]] = _bytearray8

    def _wrapped(self, state: dict[str, Any]) -> Shaped[np.ndarray, "..."] | Any:
        """joblib's array, whose numbers lie behind the opcodes."""
        kind, shape = dtype_of(state["dtype"]), tuple(int(n) for n in state["shape"])
        if kind.hasobject:
            return self._nested_pickle()
        if state.get("numpy_array_alignment_bytes") is not None:
            self._stream.read(self._stream.read(1)[0])
        length = product(shape) * kind.itemsize
        if min(shape, default=0) < 0 or length > len(self._stream.getbuffer()):
            raise pickle.UnpicklingError(f"an array of {shape} that is not there")
        content = np.frombuffer(self._stream.read(length), kind)
        return content.reshape(shape, order="F" if state["order"] == "F" else "C")

    def _nested_pickle(self) -> Any:
        if self._nested >= MAX_NESTED:
            raise pickle.UnpicklingError("pickles nested too deeply")
        return InertUnpickler(self._stream, nested=self._nested + 1).load()


def _number_of(kind: Any) -> str:
    """numpy's name of a storage's numbers."""
    if isinstance(kind, type) and issubclass(kind, Named) and kind.__name__ in STORAGES:
        return STORAGES[kind.__name__]
    raise pickle.UnpicklingError("a storage of an unknown kind")


def load_inert(data: bytes, fetch: FetchStorage | None = None) -> Any:
    """What a pickle holds, in dictionaries, lists and inert records.

    Raises:
        UnsafePickleError: If it names anything that is not on the list.
        Exception: Of any kind, if it is damaged.
    """
    content = InertUnpickler(io.BytesIO(data), fetch).load()
    return old_torch(data, 0) if content == OLD_TORCH else content


def old_torch(data: bytes, nested: int) -> Any:
    """What a file in torch's old format holds: some pickles, then the storages' numbers."""
    if nested > MAX_NESTED:
        raise pickle.UnpicklingError("files nested too deeply")
    stream = io.BytesIO(data)
    for _ in range(3):  # magic number, version, byte order
        InertUnpickler(stream, nested=nested).load()
    reader = InertUnpickler(stream, lambda name, length: b"", nested=nested)
    content, names = reader.load(), InertUnpickler(stream, nested=nested).load()
    for name in names:
        storage = reader._storages[str(name)]
        kind, count = storage.state
        (stated,) = struct.unpack("<q", stream.read(8))
        if stated != count or not 0 <= count * kind.itemsize <= len(data):
            raise pickle.UnpicklingError("a storage of another length than its tensor says")
        storage.content = np.frombuffer(stream.read(count * kind.itemsize), kind, count)
    return content


def _old_storage(raw: Any, nested: int) -> Inert:
    storage = old_torch(raw if isinstance(raw, bytes) else raw.encode("latin1"), nested)
    if not isinstance(storage, Storage):
        raise pickle.UnpicklingError("bytes that hold no storage")
    return storage

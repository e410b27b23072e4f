"""What strangers' pickle files hold, of Python 2 too, without executing any of it."""

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from capture.input_error import InputError
from preprocess.pickles.inert_unpickler import FetchStorage, UnsafePickleError, load_inert
from preprocess.pickles.pickle_records import (
    Array,
    Encoded,
    Inert,
    Mapping,
    SparseColumns,
    array_of,
    dtype_of,
)

MAX_BYTES = 1 << 30
"""Larger files are refused (SMPL with 300 betas takes a quarter of it)."""

MAX_ITEMS = 1 << 21
"""Files that hold more dictionaries, lists and numbers than that are refused."""

MAX_DEPTH = 16
"""How deep dictionaries and lists may lie in one another."""


def read_pickled_arrays(path: Path, keys: Collection[str]) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Those of the entries `keys` of a pickled dictionary that it has, as arrays.

    Reads plain numpy arrays of Python 2 and 3, chumpy's variables, selections and transpositions,
    and scipy's csc matrices (made dense).

    Raises:
        InputError: If the file is too large, is no pickle of a dictionary, holds anything that would
            have to be executed, or if a wanted entry is no array.
    """
    content = explain_failures(path, lambda: load_inert(read_limited(path)))
    if not isinstance(content, dict):
        raise InputError(f"{path} holds a {type(content).__name__}; a dictionary was expected.")
    arrays = {}
    for key in keys:
        if dict.__contains__(content, key):
            try:
                arrays[key] = array_of(dict.__getitem__(content, key))
            except Exception as cause:  # the records hold whatever the file says
                raise InputError(f"`{key}` in {path} is no readable array ({cause}).") from cause
    return arrays


def load_plain_pickle(data: bytes, fetch: FetchStorage | None = None) -> Any:
    """What a pickle holds as dictionaries, lists, numbers, texts and numpy arrays.

    Raises:
        UnsafePickleError: If it names anything that is not on the list.
        Exception: Of any kind, if it is damaged or too large.
    """
    return _Plain().of(load_inert(data, fetch))


def explain_failures(path: Path, read: Callable[[], Any], kind: str = "pickle") -> Any:
    """What `read` gives, or what is wrong with the file, in words.

    Raises:
        InputError: If the file asks to run something, or `read` fails in any other way.
    """
    try:
        return read()
    except (InputError, PermissionError):  # a command says who may not read what
        raise
    except UnsafePickleError as found:
        raise InputError(
            f"{path} is a pickle that asks to run {found}; it was refused and nothing was run. "
            "A body or pose file holds arrays only: get it from its authors again, or convert it "
            "to .npz."
        ) from None
    except Exception as cause:  # a broken pickle may fail in any way: see the pickle documentation
        # a KeyError's text is the byte or name that was not expected, and tells nobody anything
        why = "it holds something else" if isinstance(cause, KeyError) else cause
        raise InputError(f"{path} is no readable {kind} ({why}). Is the file complete?") from cause


def read_limited(path: Path) -> bytes:
    """The bytes of a file, unless there are too many.

    Raises:
        InputError: If it is too large.
    """
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise InputError(
            f"{path} has {size >> 20} MiB; pickles of more than {MAX_BYTES >> 20} MiB are not read."
        )
    return path.read_bytes()


class _Plain:
    """Turns inert records into plain things, each record once, with a limit on all of them."""

    def __init__(self) -> None:
        self._items, self._made_bytes = 0, 0
        self._known: dict[int, Any] = {}
        self._kept: list[Any] = []
        """Records that were made on the way: their ids must not be used again."""

    def of(self, thing: Any, depth: int = 0) -> Any:
        """The plain thing; a record that was seen before is the same thing again."""
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
            case dict() | Mapping():
                self._count(len(thing))
                return {
                    self._key(key, depth): self.of(value, depth) for key, value in dict.items(thing)
                }
            case list() | tuple() | set() | frozenset():
                self._count(len(thing))
                return [self.of(part, depth) for part in thing]
            case Encoded():
                return str(thing.arguments[0])
            case Array() if dtype_of(thing.state[2]).hasobject:
                return self._objects(thing, depth)
            case Inert():
                return self._array(thing)
        raise ValueError(f"a {type(thing).__name__}")

    def _key(self, key: Any, depth: int) -> Any:
        plain = self.of(key, depth)
        if isinstance(plain, np.ndarray | np.generic):
            plain = plain.item()
        return tuple(plain) if isinstance(plain, list) else plain

    def _objects(self, thing: Array, depth: int) -> Any:
        """An array of objects as a list; a single object as itself."""
        _, shape, _, _, raw = thing.state
        parts = [self.of(part, depth) for part in raw]
        self._count(len(parts))
        return parts[0] if shape == () and len(parts) == 1 else parts

    def _array(self, thing: Inert) -> Shaped[np.ndarray, "..."]:
        """The array of a record; what had to be made of little is counted."""
        array = array_of(thing)
        if isinstance(thing, SparseColumns):
            self._made_bytes += array.nbytes
            if self._made_bytes > MAX_BYTES:
                raise ValueError(f"arrays that grow beyond {MAX_BYTES >> 20} MiB")
        return array

    def _count(self, more: int) -> None:
        self._items += more
        if self._items > MAX_ITEMS:
            raise ValueError(f"more than {MAX_ITEMS} things")

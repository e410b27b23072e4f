"""The one way in which this project compiles Python to machine code."""

import functools
import hashlib
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

FAST_MATH: dict[str, Any] = {"fastmath": True, "error_model": "numpy", "nogil": True}
"""Of a kernel: sums may be reordered, nothing raises on a zero divisor, other threads run on."""
NO_ALLOCATION: dict[str, Any] = {**FAST_MATH, "_nrt": False}
"""Of a kernel that allocates nothing: no array is counted when it is named or passed on. Counting
is atomic, and takes half of the time where arrays go from one small kernel to the next."""


def compile_kernel(
    *, cache: bool = True, **options: Any
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """A decorator: `numba.njit(**options)` with the machine code kept on disk.

    Shape-checking hooks wrap every function of a module under test, and numba cannot compile the
    wrapper; so the function is unwrapped first. Numba recompiles when the function's own file has
    changed, but not when a kernel that it calls lies in another; so here the kept code belongs to
    the sources of the whole folder. Where neither the folder nor the home folder can be written
    to, nothing is kept, and every process compiles anew.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        plain = inspect.unwrap(function)
        try:
            kernel = numba.njit(cache=cache, **options)(plain)
        except RuntimeError:  # "no locator available": no place to keep it
            kernel = numba.njit(**options)(plain)
        file = getattr(getattr(kernel, "_cache", None), "_cache_file", None)
        if file is not None:
            file._source_stamp = _source_digest(Path(plain.__code__.co_filename).parent)
        return kernel

    return decorate


@functools.cache
def _source_digest(folder: Path) -> str:
    """A digest of every source in a folder."""
    digest = hashlib.sha256()
    for path in sorted(folder.glob("*.py")):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()

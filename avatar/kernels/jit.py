"""The one way in which this project compiles Python to machine code."""

import inspect
from collections.abc import Callable
from typing import Any

import numba


def compile_kernel(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """A decorator: `numba.njit(**options)` with the machine code kept on disk (`cache=True`).

    Shape-checking hooks wrap every function of a module under test, and numba cannot compile the
    wrapper; so the function is unwrapped first.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        return numba.njit(**{"cache": True, **options})(inspect.unwrap(function))

    return decorate

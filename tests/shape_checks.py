"""What jaxtyping's import hook writes above each function: types and shapes, checked once a call.

The hook's own decorator binds the arguments and checks them twice, and it compiles the checks of an
inner function at each call of the outer one. This one leaves inner functions out, and those
without annotations; and it checks the first hundred calls of a function in each test, of which some
make a hundred thousand.
"""

import functools
import inspect
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, ForwardRef, get_args

from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray, TypeCheckError, jaxtyped

CHECK = beartype(conf=BeartypeConf(violation_type=TypeCheckError))
"""Raises what jaxtyping raises, which is a TypeError."""
ONE_CALL = jaxtyped("context")
"""Within it a name of an axis means one length."""
CHECKED_CALLS = 100
"""Calls of a function that are checked in a test."""
calls = Counter[Callable]()
"""Checked calls of each function in this test; cleared before each."""


def check_calls(function: Any = None, *, typechecker: Callable) -> Any:
    """Decorates as `jaxtyping.jaxtyped` does: a function, a method or a dataclass."""
    if function is None:
        return functools.partial(check_calls, typechecker=typechecker)
    if isinstance(function, classmethod | staticmethod):
        return type(function)(check_calls(function.__func__, typechecker=typechecker))
    if inspect.isclass(function):
        init = function.__init__
        jaxtyped(function, typechecker=typechecker)
        if function.__init__ is not init:
            function.__init__ = _first_calls(init, function.__init__)
        return function
    if not inspect.isfunction(function):
        return jaxtyped(function, typechecker=typechecker)
    if inspect.isgeneratorfunction(function):
        return _first_calls(function, jaxtyped(function, typechecker=typechecker))
    if "<locals>" in function.__qualname__ or not function.__annotations__:
        return function
    types = [part for each in function.__annotations__.values() for part in _parts(each)]
    if any(isinstance(part, str | ForwardRef) for part in types):  # may only be known later
        return _first_calls(function, jaxtyped(function, typechecker=typechecker))
    checked = CHECK(function)
    if not any(inspect.isclass(part) and issubclass(part, AbstractArray) for part in types):
        return checked

    def within_one_call(*args: Any, **kwargs: Any) -> Any:
        with ONE_CALL:
            return checked(*args, **kwargs)

    return _first_calls(function, within_one_call)


def _first_calls(function: Callable, checked: Callable) -> Callable:
    """The checked function for the first calls in a test, and the function itself for others."""

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        if calls[function] >= CHECKED_CALLS:
            return function(*args, **kwargs)
        calls[function] += 1
        return checked(*args, **kwargs)

    return call


def _parts(annotation: Any) -> Iterator[Any]:
    """The annotation and all that it is made of."""
    yield annotation
    for part in get_args(annotation):
        yield from _parts(part)

"""What jaxtyping's import hook writes above each function: types and shapes, checked once a call.

The hook's own decorator binds the arguments and checks them twice, and it compiles the checks of an
inner function at each call of the outer one. This one leaves inner functions out, and those
without annotations; and it checks the first hundred calls of a function in each test, of which some
make a hundred thousand.
"""

import contextlib
import dataclasses
import functools
import inspect
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, ForwardRef, get_args, get_type_hints

from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray, TypeCheckError, jaxtyped

CHECK = beartype(conf=BeartypeConf(violation_type=TypeCheckError))
"""Raises what jaxtyping raises, which is a TypeError."""
ONE_CALL = jaxtyped("context")
"""Within it a name of an axis means one length."""
CHECKED_CALLS = 100
"""Calls of a function that are checked in a test, at most."""
calls = Counter[Callable]()
"""Those so far in this test; cleared before each."""


def check_calls(function: Any = None, *, typechecker: Callable) -> Any:
    """Decorates as `jaxtyping.jaxtyped` does: a function, a method or a dataclass."""
    if function is None:
        return functools.partial(check_calls, typechecker=typechecker)
    if isinstance(function, classmethod | staticmethod):
        return type(function)(check_calls(function.__func__, typechecker=typechecker))
    if inspect.isclass(function):
        if dataclasses.is_dataclass(function) and "__init__" in vars(function):
            function.__init__ = check_calls(function.__init__, typechecker=typechecker)
        return function
    if not inspect.isfunction(function) or inspect.isgeneratorfunction(function):
        return jaxtyped(function, typechecker=typechecker)
    if "<locals>" in function.__qualname__ or not function.__annotations__:
        return function
    types = [part for each in function.__annotations__.values() for part in _parts(each)]
    has_shapes = any(
        isinstance(part, str | ForwardRef)
        or (inspect.isclass(part) and issubclass(part, AbstractArray))
        for part in types
    )

    @functools.cache
    def checked() -> Callable:
        try:
            get_type_hints(function)
        except NameError:  # a name that is imported for type checkers alone
            return function
        return CHECK(function)  # two milliseconds, and most tests call few functions

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        if calls[function] >= CHECKED_CALLS:
            return function(*args, **kwargs)
        calls[function] += 1
        with ONE_CALL if has_shapes else contextlib.nullcontext():
            return checked()(*args, **kwargs)

    return call


def _parts(annotation: Any) -> Iterator[Any]:
    """The annotation and all that it is made of."""
    yield annotation
    for part in get_args(annotation):
        yield from _parts(part)

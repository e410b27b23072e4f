"""Work on items of a sequence on other threads, a few items ahead of the one who takes results."""

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from itertools import repeat
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
RESULTS_PER_WORKER = 2
"""Results of each thread that may wait: one is taken while the next is made."""


def map_ahead(
    function: Callable[[Item], Result], items: Iterable[Item], *, workers: int
) -> Generator[Result, None, None]:
    """Yield a function of each item, in order, made by several threads.

    Results do not depend on the number of threads, of which there is at least one besides the
    caller's; it pays where the function releases Python's lock. An error is raised at its item's
    place. Items are taken on the caller's thread, at most `RESULTS_PER_WORKER` a thread ahead; what
    has not begun when the caller leaves is left out.
    """
    with ThreadPoolExecutor(workers) as executor:
        waiting = deque[Future[Result]]()
        try:
            for item in items:
                waiting.append(executor.submit(function, item))
                if len(waiting) >= RESULTS_PER_WORKER * workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def read_ahead(items: Iterable[Item]) -> Generator[Item, None, None]:
    """Yield items that another thread reads, such as frames that it decodes.

    At most `RESULTS_PER_WORKER` are held back. A generator of items is closed once the caller
    leaves.
    """
    iterator, end = iter(items), object()
    try:
        with closing(map_ahead(lambda _: next(iterator, end), repeat(None), workers=1)) as ahead:
            for item in ahead:
                if item is end:
                    return
                yield item  # pyright: ignore[reportReturnType]
    finally:
        if isinstance(iterator, Generator):
            iterator.close()

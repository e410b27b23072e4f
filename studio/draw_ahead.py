"""Pictures in order, a few of them drawn ahead on other threads."""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from os import cpu_count

import numpy as np
from jaxtyping import Float32, UInt8

RenderedFrame = tuple[UInt8[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]]
"""The actor on the stage, and the exact soft mask."""

ShootProgress = Callable[[int, int], None]
"""Called after each picture with how many are done and how many there will be."""


def draw_ahead(render: Callable[[int], RenderedFrame], count: int) -> Iterator[RenderedFrame]:
    """The pictures 0 … count - 1 in order, as `render` draws them."""
    workers = max(1, min(4, cpu_count() or 1))
    with ThreadPoolExecutor(workers) as pool:
        ahead = deque()
        try:
            for row in range(count):
                ahead.append(pool.submit(render, row))
                if len(ahead) > workers:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        finally:
            for waiting in ahead:
                waiting.cancel()

"""Times of alternatives that do the same work, taken turn by turn in one process."""

import statistics
import time
from collections.abc import Callable, Mapping

import numba
import torch


def limit_threads(count: int) -> None:
    """How many threads numba and torch may use from now on."""
    torch.set_num_threads(count)
    numba.set_num_threads(count)


def time_interleaved(
    alternatives: Mapping[str, Callable[[], object]],
    *,
    rounds: int = 5,
) -> dict[str, float]:
    """Median seconds of each alternative.

    These are seconds of one core (process time, one thread): what else runs on the machine hardly
    counts.

    Args:
        alternatives: Each is called once to warm up, then once a round, in turn.
        rounds: How often each is timed.
    """
    limit_threads(1)
    for work in alternatives.values():
        work()
    spent: dict[str, list[float]] = {name: [] for name in alternatives}
    for _ in range(rounds):
        for name, work in alternatives.items():
            began = time.process_time()
            work()
            spent[name].append(time.process_time() - began)
    return {name: statistics.median(times) for name, times in spent.items()}

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
    fewer_rounds: Mapping[str, int] | None = None,
) -> dict[str, float]:
    """Median seconds of each alternative.

    These are seconds of one core (process time, one thread): what else runs on the machine hardly
    counts.

    Args:
        alternatives: Each is called once to warm up, then once a round, in turn.
        rounds: How often each is timed.
        seldom: Those that are too slow for that: how often instead, and without warming up.
    """
    fewer_rounds = fewer_rounds or {}
    limit_threads(1)
    for name, work in alternatives.items():
        if name not in fewer_rounds:
            work()
    spent: dict[str, list[float]] = {name: [] for name in alternatives}
    for turn in range(rounds):
        for name, work in alternatives.items():
            if turn < fewer_rounds.get(name, rounds):
                began = time.process_time()
                work()
                spent[name].append(time.process_time() - began)
    return {name: statistics.median(times) for name, times in spent.items()}

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
    device: torch.device,
    *,
    rounds: int = 5,
    fewer_rounds: Mapping[str, int] | None = None,
) -> dict[str, float]:
    """Median seconds of each alternative.

    On the CPU these are seconds of one core (process time, one thread): what else runs on the
    machine hardly counts. On a GPU they are wall seconds between two synchronisations.

    Args:
        alternatives: Each is called once to warm up, then once a round, in turn.
        device: Where they run.
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
                began = _now(device)
                work()
                spent[name].append(_now(device) - began)
    return {name: statistics.median(times) for name, times in spent.items()}


def _now(device: torch.device) -> float:
    if device.type != "cuda":
        return time.process_time()
    torch.cuda.synchronize(device)
    return time.perf_counter()

"""Times of alternatives that do the same work, taken turn by turn in one process."""

import statistics
import time
from collections.abc import Callable, Mapping

import numba
import torch


def use_threads(count: int) -> None:
    """How many threads numba and torch may use from now on."""
    torch.set_num_threads(count)
    numba.set_num_threads(count)


def interleaved(
    alternatives: Mapping[str, Callable[[], object]],
    device: torch.device,
    *,
    rounds: int = 5,
    seldom: Mapping[str, int] | None = None,
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
    seldom = seldom or {}
    use_threads(1)
    for name, work in alternatives.items():
        if name not in seldom:
            work()
    spent: dict[str, list[float]] = {name: [] for name in alternatives}
    for turn in range(rounds):
        for name, work in alternatives.items():
            if turn < seldom.get(name, rounds):
                began = _now(device)
                work()
                spent[name].append(_now(device) - began)
    return {name: statistics.median(times) for name, times in spent.items()}


def _now(device: torch.device) -> float:
    if device.type != "cuda":
        return time.process_time()
    torch.cuda.synchronize(device)
    return time.perf_counter()

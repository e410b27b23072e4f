"""How many threads the trainer has."""

import os

import numba
import torch


def set_threads(requested: int | None) -> int:
    """Sets torch's and numba's threads: what was asked for, else one for each core we may use.

    Returns:
        How many there are now; numba cannot have more than it started with.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    threads = max(1, min(requested or cores or 1, numba.get_num_threads()))
    torch.set_num_threads(threads)
    numba.set_num_threads(threads)
    return threads

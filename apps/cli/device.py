"""The device that trains and renders.

How many threads the trainer has.
"""

import os

import numba
import torch

from capture.input_error import InputError

CUDA_SLOW_WARNING = (
    "--device cuda runs the plain-torch reference, which is slower than the CPU: there are no CUDA "
    "kernels yet. Leave --device out to train on the CPU."
)


def resolve_device(name: str) -> torch.device:
    """Returns the device for --device.

    Args:
        name: "cpu", "cuda", or "auto". Auto is the CPU, which is faster until there are CUDA
            kernels.

    Raises:
        InputError: If CUDA was asked for, and torch sees no GPU.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "--device cuda was asked for, but torch sees no GPU here. Leave --device out, or "
            "install torch with CUDA and check nvidia-smi."
        )
    return torch.device("cuda" if name == "cuda" else "cpu")


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

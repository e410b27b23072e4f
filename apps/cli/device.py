"""Device and threads for training and rendering."""

import numba
import torch

from apps.report.hardware import usable_cores
from capture.input_error import InputError

CUDA_SLOW_WARNING = (
    "--device cuda runs the plain-torch reference, which is slower than the CPU: there are no CUDA "
    "kernels yet. Omit --device to train on the CPU."
)
"""Warning for --device cuda."""


def resolve_device(name: str) -> torch.device:
    """Return the device for --device.

    Args:
        name: "cpu", "cuda", or "auto". Auto is the CPU, which is faster until there are CUDA
            kernels.

    Raises:
        InputError: If CUDA is requested, but torch finds no GPU.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "--device cuda requires a GPU, but torch finds none. Omit --device, or install torch "
            "with CUDA and check nvidia-smi."
        )
    return torch.device("cuda" if name == "cuda" else "cpu")


def set_threads(requested: int | None) -> int:
    """Set the threads of torch and numba: as requested, else one per usable core.

    Returns:
        The number of threads; numba cannot exceed the number it started with.
    """
    threads = max(1, min(requested or usable_cores(), numba.get_num_threads()))
    torch.set_num_threads(threads)
    numba.set_num_threads(threads)
    return threads

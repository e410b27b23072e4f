"""Which backend a device gets: the fastest that it has and that is right on this machine."""

import functools
import os
import warnings

import torch

from avatar.kernels.backend import Backend, TorchBackend
from avatar.kernels.selftest import strays


def backend_for(device: torch.device) -> Backend:
    """The fastest backend that the device has; `IA_BACKEND=torch|numba` forces one.

    Raises:
        ValueError: If the forced backend is unknown or cannot run on the device.
    """
    forced = os.environ.get("IA_BACKEND", "")
    if forced not in ("", "torch", "numba"):
        raise ValueError(f"IA_BACKEND is '{forced}'; it may be 'torch' or 'numba'.")
    if forced == "numba" and device.type != "cpu":
        raise ValueError(f"IA_BACKEND=numba runs on the CPU only, not on {device}.")
    if forced == "torch" or device.type != "cpu":
        return TorchBackend()
    return _numba() if _numba_is_sound() else TorchBackend()


def _numba() -> Backend:
    from avatar.kernels.cpu import NumbaBackend  # it compiles: only where it is used

    return NumbaBackend()


@functools.cache
def _numba_is_sound() -> bool:
    """Whether the compiled kernels do here what they should; asked once, answered aloud if not."""
    operation = strays(_numba())
    if operation is not None:
        warnings.warn(
            f"The compiled kernel '{operation}' differs from its meaning on this machine; plain "
            "torch is used instead, many times slower. Please report it with your processor and "
            "the version of numba; IA_BACKEND=torch keeps it quiet.",
            stacklevel=3,
        )
    return operation is None

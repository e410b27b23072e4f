"""Which backend a device gets: the fastest that it has and that is right on this machine.

The CPU has compiled twins of every operation (`avatar.kernels.cpu`). A GPU has none yet: the
reference runs there, in plain torch. Kernels of our own for it would be a class beside
`NumbaBackend` that keeps to the same protocol; `backend_for` is where it would be chosen, after
the same self-test.
"""

import functools
import os
import threading
import warnings

import torch

from avatar.kernels.backend import Backend
from avatar.kernels.selftest import failing_operation
from avatar.kernels.torch_backend import TorchBackend
from capture.errors import InputError

_SELF_TEST_LOCK = threading.Lock()


def backend_for(device: torch.device) -> Backend:
    """The fastest backend that the device has; `IA_BACKEND=torch|numba` forces one.

    Raises:
        InputError: If the forced backend is unknown or cannot run on the device.
    """
    forced = os.environ.get("IA_BACKEND", "")
    if forced not in ("", "torch", "numba"):
        raise InputError(
            f"The variable IA_BACKEND is {forced!r}; expected 'torch' or 'numba', or leave it out."
        )
    if forced == "numba" and device.type != "cpu":
        raise InputError(
            f"IA_BACKEND=numba was asked for, but it runs on the CPU only, not on {device}. "
            "Leave it out, or give --device cpu."
        )
    if device.type == "cpu" and forced != "torch":
        with _SELF_TEST_LOCK:  # kernels must not run in two threads at once: who comes second waits
            if _numba_passes_self_test():
                return _numba_backend()
    # a CudaBackend's seat: device.type == "cuda", and `strays` finds nothing on it
    return TorchBackend()


def _numba_backend() -> Backend:
    from avatar.kernels.cpu import NumbaBackend  # it compiles: only where it is used

    return NumbaBackend()


@functools.cache
def _numba_passes_self_test() -> bool:
    """Whether the compiled kernels do here what they should; asked once, answered aloud if not."""
    operation = failing_operation(_numba_backend())
    if operation is not None:
        warnings.warn(
            f"The compiled kernel '{operation}' differs from its meaning on this machine; plain "
            "torch is used instead, many times slower. Please report it with your processor and "
            "the version of numba; IA_BACKEND=torch keeps it quiet.",
            stacklevel=3,
        )
    return operation is None

"""The device that trains and renders."""

import torch

from capture.errors import InputError

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

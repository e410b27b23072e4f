"""The device that trains and renders."""

import torch

from capture.errors import BadInput

SLOW_ON_CUDA = (
    "--device cuda runs the plain-torch reference, which is slower than the CPU: there are no CUDA "
    "kernels yet. Leave --device out to train on the CPU."
)


def device_for(name: str) -> torch.device:
    """Returns the device for --device.

    Args:
        name: "cpu", "cuda", or "auto". Auto is the CPU, which is faster until there are CUDA
            kernels.

    Raises:
        BadInput: If CUDA was asked for, and torch sees no GPU.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise BadInput(
            "--device cuda was asked for, but torch sees no GPU here. Leave --device out, or "
            "install torch with CUDA and check nvidia-smi."
        )
    return torch.device("cuda" if name == "cuda" else "cpu")

"""Where training runs."""

import torch

from capture.errors import BadInput


def device_for(wish: str) -> torch.device:
    """The device that was asked for.

    Args:
        wish: "cpu", "cuda", or "auto": a GPU if there is one.

    Raises:
        BadInput: If a GPU was asked for, and there is none.
    """
    if wish == "cuda" and not torch.cuda.is_available():
        raise BadInput(
            "--device cuda was asked for, but torch sees no GPU here. Leave --device out, or "
            "install torch with CUDA and check nvidia-smi."
        )
    wanted = wish != "cpu" and torch.cuda.is_available()
    return torch.device("cuda" if wanted else "cpu")

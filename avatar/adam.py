"""torch's fused Adam without torch's compiler: the same steps, and the first a second sooner."""

import inspect
from typing import final

import torch


@final
class UncompiledAdam(torch.optim.UncompiledAdam):
    """`torch.optim.Adam` that does not load `torch._dynamo` (0.7 to 1 s) at its first use.

    torch wraps these two methods so that its compiler leaves them alone, and loads the compiler to
    say so. Nothing is compiled here, and the wrapped methods are used as they are.
    """

    add_param_group = inspect.unwrap(torch.optim.UncompiledAdam.add_param_group)
    step = torch.no_grad()(inspect.unwrap(torch.optim.UncompiledAdam.step))

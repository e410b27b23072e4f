"""Adam without torch's compiler, the learning rate's decay, and the rendered mean.

At a high learning rate the parameters oscillate about an optimum that their mean stays close to
(Polyak and Juditsky 1992). On the sample the mean gains 1.0 to 1.5 dB at any time before the rate
falls, which is the whole time while a video streams, and costs nothing afterwards.
"""

import inspect
import math
from typing import final

import torch

from avatar.field.radiance_field import RadianceField

EMA_HORIZON_STEPS = 250
"""Steps that the mean averages over; a longer horizon shows new content later."""
MAX_HORIZON_SHARE = 1 / 5
"""Largest horizon as a share of all steps so far, since the first steps were fog."""
EMA_INTERVAL = 16
"""Steps between updates of the mean."""


def cosine_decay(progress: float) -> float:
    """The learning rate's factor: 1 at progress 0, 0.05 at 1."""
    return max(0.05, 0.5 * (1.0 + math.cos(math.pi * min(max(progress, 0.0), 1.0))))


@torch.no_grad()
def update_ema(average: RadianceField, field: RadianceField, steps: int) -> None:
    """Updates the exponential mean of a field's parameters, every `EMA_INTERVAL` steps.

    Args:
        average: Mean, changed in place.
        field: Field after `steps` steps.
        steps: Number of steps, at least 1.
    """
    if steps % EMA_INTERVAL and steps > EMA_INTERVAL:
        return
    share = min(1.0, EMA_INTERVAL / min(EMA_HORIZON_STEPS, max(steps * MAX_HORIZON_SHARE, 1.0)))
    for shown, learnt in zip(average.parameters(), field.parameters(), strict=True):
        shown.lerp_(learnt, share)


@final
class UncompiledAdam(torch.optim.Adam):
    """`torch.optim.Adam` that does not load `torch._dynamo` (0.7 to 1 s) at its first use.

    torch wraps these methods to exclude them from compilation, and loads the compiler to do so.
    Nothing is compiled here, and the unwrapped methods are used.
    """

    add_param_group = inspect.unwrap(torch.optim.Adam.add_param_group)
    state_dict = inspect.unwrap(torch.optim.Adam.state_dict)
    load_state_dict = inspect.unwrap(torch.optim.Adam.load_state_dict)
    step = torch.no_grad()(inspect.unwrap(torch.optim.Adam.step))

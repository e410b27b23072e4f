"""The running mean of what is learnt: it is what is shown, scored and packed.

While the learning rate is high the parameters swing about what they have found, and their mean does
not (Polyak and Juditsky 1992). On the sample it is worth 1.0 to 1.5 dB at any time before the rate
falls, which is always while a video streams, and takes nothing away after.

torch's fused Adam without torch's compiler: the same steps, and the first a second sooner.
"""

import inspect
from typing import final

import torch

from avatar.field.radiance_field import RadianceField

EMA_HORIZON_STEPS = 250
"""Steps over which the mean reaches back: the longer, the later it shows what is new."""
MAX_HORIZON_SHARE = 1 / 5
"""Share of all steps so far that it reaches back at most: the first ones were fog."""
EMA_INTERVAL = 16
"""Steps between updates."""


@torch.no_grad()
def update_ema(average: RadianceField, field: RadianceField, steps: int) -> None:
    """Moves an exponential mean on, if it is time.

    Args:
        mean: Changed in place.
        field: As it is after so many steps.
        steps: How many, 1 or more.
    """
    if steps % EMA_INTERVAL and steps > EMA_INTERVAL:
        return
    share = min(1.0, EMA_INTERVAL / min(EMA_HORIZON_STEPS, max(steps * MAX_HORIZON_SHARE, 1.0)))
    for shown, learnt in zip(average.parameters(), field.parameters(), strict=True):
        shown.lerp_(learnt, share)


@final
class UncompiledAdam(torch.optim.Adam):
    """`torch.optim.Adam` that does not load `torch._dynamo` (0.7 to 1 s) at its first use.

    torch wraps these two methods so that its compiler leaves them alone, and loads the compiler to
    say so. Nothing is compiled here, and the wrapped methods are used as they are.
    """

    add_param_group = inspect.unwrap(torch.optim.Adam.add_param_group)
    step = torch.no_grad()(inspect.unwrap(torch.optim.Adam.step))

"""Where each garment ends: the borders, decided per subsample from the place on the body at rest.

All places are on the *template* (the mean body in T-pose, metres), so every person wears the same
cut; `x` is the body's left, `y` up, `z` out of the chest.
"""

import numpy as np
from jaxtyping import Float32

from avatar.kernels.jit import compile_kernel

SKIN, SHIRT, TROUSERS, SHOE, HAIR, EYE = 0, 1, 2, 3, 4, 5

# The tailor's measures: what each entry of a `cut` array says.
SLEEVE, HEM, CUFF, NECK_DEPTH, NAPE, EARS_COVERED, FRINGE = 0, 1, 2, 3, 4, 5, 6

BELT_Y = -0.15
"""Trousers end here; the shirt hangs over it."""


@compile_kernel(nogil=True, inline="always")
def ramp(value: float, low: float, high: float) -> float:
    """0 below `low`, 1 above `high`, smooth between."""
    share = min(max((value - low) / (high - low), 0.0), 1.0)
    return share * share * (3.0 - 2.0 * share)


@compile_kernel(nogil=True, inline="always")
def neckline(x: float, z: float, cut: Float32[np.ndarray, "cuts"]) -> float:
    """Height of the collar's edge: a scoop, deeper in front, that ends on the shoulders."""
    front = ramp(z, 0.01, 0.09)
    side = abs(x + 0.002)
    return (
        0.350 - cut[NECK_DEPTH] * front + 14.0 * max(side - 0.06, 0.0) ** 2 + max(side - 0.1, 0.0)
    )


@compile_kernel(nogil=True, inline="always")
def inside_hair(x: float, y: float, z: float, cut: Float32[np.ndarray, "cuts"]) -> float:
    """How far above the hairline a place of the head is, in metres (negative: bare)."""
    side = abs(x + 0.002)
    edge = cut[NAPE] + (0.478 - cut[NAPE]) * ramp(z, 0.02, 0.075)
    edge += 0.035 * ramp(z, 0.088, 0.104)
    edge += (cut[FRINGE] - 0.513) * ramp(z, 0.104, 0.142)
    height = y - edge + 0.002 * np.sin(side * 420.0 + y * 130.0)
    if cut[EARS_COVERED] < 0.5 and side > 0.06:
        ear = np.hypot((z - 0.066) / 0.026, (y - 0.478) / 0.034)
        height = min(height, 0.03 * (ear - 1.0))
    return height


@compile_kernel(nogil=True)
def keeps(kind: int, x: float, y: float, z: float, cut: Float32[np.ndarray, "cuts"]) -> bool:
    """Whether a place of a garment is there, and a place of the skin is bare."""
    side = abs(x)
    if kind == SHIRT:
        hem = cut[HEM] + 0.006 * np.sin(x * 31.0 + z * 17.0)
        return side < cut[SLEEVE] and y > hem and y < neckline(x, z, cut)
    if kind == TROUSERS:
        return y < BELT_Y and y > cut[CUFF]
    if kind == HAIR:
        return inside_hair(x, y, z, cut) > 0.0
    if kind == SKIN:
        under_shirt = side < cut[SLEEVE] - 0.03 and y > cut[HEM] + 0.03
        under_shirt = under_shirt and y < neckline(x, z, cut) - 0.02
        under_trousers = y < BELT_Y - 0.02 and y > cut[CUFF] + 0.02
        return not (under_shirt or under_trousers or y < -1.165)
    return True

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
def smoothstep(value: float, low: float, high: float) -> float:
    """0 below `low`, 1 above `high`, smooth between."""
    share = min(max((value - low) / (high - low), 0.0), 1.0)
    return share * share * (3.0 - 2.0 * share)


@compile_kernel(nogil=True, inline="always")
def neckline(x: float, z: float, measures: Float32[np.ndarray, "cuts"]) -> float:
    """Height of the collar's edge: a scoop, deeper in front, that ends on the shoulders."""
    front = smoothstep(z, 0.01, 0.09)
    side = abs(x + 0.002)
    return (
        0.350 - measures[NECK_DEPTH] * front + 14.0 * max(side - 0.06, 0.0) ** 2 + max(side - 0.1, 0.0)
    )


@compile_kernel(nogil=True, inline="always")
def height_above_hairline(x: float, y: float, z: float, measures: Float32[np.ndarray, "cuts"]) -> float:
    """How far above the hairline a place of the head is, in metres (negative: bare)."""
    side = abs(x + 0.002)
    edge = measures[NAPE] + (0.478 - measures[NAPE]) * smoothstep(z, 0.02, 0.075)
    edge += 0.035 * smoothstep(z, 0.088, 0.104)
    edge += (measures[FRINGE] - 0.513) * smoothstep(z, 0.104, 0.142)
    height = y - edge + 0.002 * np.sin(side * 420.0 + y * 130.0)
    if measures[EARS_COVERED] < 0.5 and side > 0.06:
        ear = np.hypot((z - 0.066) / 0.026, (y - 0.478) / 0.034)
        height = min(height, 0.03 * (ear - 1.0))
    return height


@compile_kernel(nogil=True)
def is_visible(material: int, x: float, y: float, z: float, measures: Float32[np.ndarray, "cuts"]) -> bool:
    """Whether a place of a garment is there, and a place of the skin is bare."""
    side = abs(x)
    if material == SHIRT:
        hem = measures[HEM] + 0.006 * np.sin(x * 31.0 + z * 17.0)
        return side < measures[SLEEVE] and y > hem and y < neckline(x, z, measures)
    if material == TROUSERS:
        return y < BELT_Y and y > measures[CUFF]
    if material == HAIR:
        return height_above_hairline(x, y, z, measures) > 0.0
    if material == SKIN:
        under_shirt = side < measures[SLEEVE] - 0.03 and y > measures[HEM] + 0.03
        under_shirt = under_shirt and y < neckline(x, z, measures) - 0.02
        under_trousers = y < BELT_Y - 0.02 and y > measures[CUFF] + 0.02
        return not (under_shirt or under_trousers or y < -1.165)
    return True

"""Which side of a mask is the person."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from capture.errors import BadInput

HALF = 0.5
"""Nobody covers more of the pictures, and of their rims."""
MOST_OBJECTS = 32
LEAST_AREA = 0.01
"""Specks of compression cover less than objects do."""
DARK, BRIGHT = 0.1, 0.9
"""Between them are only the rims of soft masks."""


def show_background(samples: list[Float32[np.ndarray, "_ _"]], path: Path) -> bool:
    """Whether masks are 1 where the person is not: on most of the picture and of its rim.

    Raises:
        BadInput: If they are empty, or neither side can be the person.
    """
    shares = np.array([_shares(mask) for mask in samples])
    told = shares[(shares[:, 0] > 0.0) & (shares[:, 0] < 1.0)]
    if not len(told):
        raise BadInput(
            f"The masks in {path} show nothing: all {len(samples)} that were looked at are empty "
            "or full. Expected the person at 255 and the rest at 0."
        )
    area, rim = np.median(told, axis=0)
    if (area > HALF) != (rim > HALF):
        raise BadInput(
            f"It cannot be seen which side of the masks in {path} is the person: they cover "
            f"{area:.0%} of the pictures and {rim:.0%} of the rims. Say so with --mask-invert (the "
            "person is 0) or --no-mask-invert (the person is 255)."
        )
    return bool(area > HALF)


def check_are_masks(samples: list[Float32[np.ndarray, "_ _"]], path: Path) -> None:
    """Raises BadInput for pictures, depths and the like: masks are nearly everywhere 0 or 1."""
    between = [float(((mask > DARK) & (mask < BRIGHT)).mean()) for mask in samples]
    if np.median(between) > HALF:
        raise BadInput(
            f"{path} holds pictures, not masks: {np.median(between):.0%} of their pixels are "
            "neither dark nor bright. Expected 255 where the person is, and 0 elsewhere."
        )


def are_numbers(samples: list[Float32[np.ndarray, "_ _"]]) -> bool:
    """Whether masks hold objects' numbers, 1, 2, …, of 255, rather than brightness."""
    if max(float(mask.max()) for mask in samples) > MOST_OBJECTS / 255.0:
        return False
    found = np.unique(np.concatenate([np.unique(mask) for mask in samples]))
    area = float(np.median([float((mask > 0.0).mean()) for mask in samples]))
    return len(found) <= MOST_OBJECTS and area > LEAST_AREA


def is_turned(alpha: Float32[np.ndarray, "height width"]) -> bool:
    """Whether one mask among others that are in order shows the background."""
    area, rim = _shares(alpha)
    return bool(area > HALF and rim > HALF)


def _shares(alpha: Float32[np.ndarray, "height width"]) -> Float[np.ndarray, "2"]:
    """How much of the picture, and of its rim, is covered."""
    rim = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
    return np.array([alpha.mean(), rim.mean()], dtype=np.float64)

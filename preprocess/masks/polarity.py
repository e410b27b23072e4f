"""Which side of a mask is the person."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from capture.errors import InputError

MAX_PERSON_FRACTION = 0.5
"""Nobody covers more of the pictures, and of their rims."""
MAX_OBJECTS = 32
MIN_OBJECT_AREA = 0.01
"""Specks of compression cover less than objects do."""
SOFT_MIN, SOFT_MAX = 0.1, 0.9
"""ResectionResult them are only the rims of soft masks."""


def shows_background(samples: list[Float32[np.ndarray, "_ _"]], path: Path) -> bool:
    """Whether masks are 1 where the person is not: on most of the picture and of its rim.

    Raises:
        InputError: If they are empty, or neither side can be the person.
    """
    shares = np.array([_coverage(mask) for mask in samples])
    told = shares[(shares[:, 0] > 0.0) & (shares[:, 0] < 1.0)]
    if not len(told):
        raise InputError(
            f"The masks in {path} show nothing: all {len(samples)} that were looked at are empty "
            "or full. Expected the person at 255 and the rest at 0."
        )
    area, rim = np.median(told, axis=0)
    if (area > MAX_PERSON_FRACTION) != (rim > MAX_PERSON_FRACTION):
        raise InputError(
            f"It cannot be seen which side of the masks in {path} is the person: they cover "
            f"{area:.0%} of the pictures and {rim:.0%} of the rims. Say so with --mask-invert (the "
            "person is 0) or --no-mask-invert (the person is 255)."
        )
    return bool(area > MAX_PERSON_FRACTION)


def check_are_masks(samples: list[Float32[np.ndarray, "_ _"]], path: Path) -> None:
    """Raises InputError for pictures, depths and the like: masks are nearly everywhere 0 or 1."""
    between = [float(((mask > SOFT_MIN) & (mask < SOFT_MAX)).mean()) for mask in samples]
    if np.median(between) > MAX_PERSON_FRACTION:
        raise InputError(
            f"{path} holds pictures, not masks: {np.median(between):.0%} of their pixels are "
            "neither dark nor bright. Expected 255 where the person is, and 0 elsewhere."
        )


def are_object_ids(samples: list[Float32[np.ndarray, "_ _"]]) -> bool:
    """Whether masks hold objects' numbers, 1, 2, …, of 255, rather than brightness."""
    if max(float(mask.max()) for mask in samples) > MAX_OBJECTS / 255.0:
        return False
    found = np.unique(np.concatenate([np.unique(mask) for mask in samples]))
    area = float(np.median([float((mask > 0.0).mean()) for mask in samples]))
    return len(found) <= MAX_OBJECTS and area > MIN_OBJECT_AREA


def is_inverted(alpha: Float32[np.ndarray, "height width"]) -> bool:
    """Whether one mask among others that are in order shows the background."""
    area, rim = _coverage(alpha)
    return bool(area > MAX_PERSON_FRACTION and rim > MAX_PERSON_FRACTION)


def _coverage(alpha: Float32[np.ndarray, "height width"]) -> Float[np.ndarray, "2"]:
    """How much of the picture, and of its rim, is covered."""
    rim = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
    return np.array([alpha.mean(), rim.mean()], dtype=np.float64)

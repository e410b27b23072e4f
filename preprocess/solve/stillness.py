"""Whether the camera stood still: then there is nothing to solve."""

from dataclasses import dataclass

import numpy as np

from preprocess.solve.keyframes import KeyFrame
from preprocess.solve.tracking import corners, followed

CORNERS = 400
LEAST_FOLLOWED = 0.3
"""Share of the points that must be found again before they say that nothing moved."""
STILL = 0.005
"""How far the background may move in the picture, in longer sides: 5 px of 960."""
LEAST_POINTS = 12
LOOKED_AT = 12
"""Key frames that are compared with the first."""


@dataclass(frozen=True, kw_only=True)
class Stillness:
    """How far the background moves in the picture.

    Attributes:
        still: Whether the camera counts as standing.
        moved: The largest shift of the background between the first key frame and another, in
            longer sides of the picture (median over its points); NaN if it was lost.
    """

    still: bool
    moved: float


def stillness(keys: list[KeyFrame]) -> Stillness:
    """Follows points of the first key frame's background into others."""
    first = keys[0]
    pixels = corners(first.grey, ~first.person, CORNERS)
    longer, moved = max(first.grey.shape), 0.0
    if len(pixels) < LEAST_POINTS:
        return Stillness(still=False, moved=float("nan"))
    rows = np.unique(np.linspace(1, len(keys) - 1, LOOKED_AT).round().astype(int))
    for key in (keys[int(row)] for row in rows):
        there, found = followed(first.grey, key.grey, pixels)
        x, y = np.clip(pixels.astype(int).T, 0, np.array(key.grey.shape[::-1])[:, None] - 1)
        open_view = ~key.person[y, x]
        found &= open_view
        if found.sum() < max(LEAST_POINTS, LEAST_FOLLOWED * open_view.sum()):
            return Stillness(still=False, moved=float("nan"))
        shift = float(np.median(np.linalg.norm(there - pixels, axis=1)[found])) / longer
        moved = max(moved, shift)
        if moved > STILL:
            return Stillness(still=False, moved=moved)
    return Stillness(still=True, moved=moved)

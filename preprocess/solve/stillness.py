"""Whether the camera stood still: then there is nothing to solve."""

from dataclasses import dataclass

import numpy as np

from preprocess.solve.keyframes import SfmKeyframe
from preprocess.solve.tracking import detect_corners, track_points

MAX_CORNERS = 400
MIN_TRACKED_FRACTION = 0.3
"""Share of the points that must be found again before they say that nothing moved."""
MAX_STATIC_SHIFT = 0.005
"""How far the background may move in the picture, in longer sides: 5 px of 960."""
MIN_TRACKED_POINTS = 12
COMPARED_KEYFRAMES = 12
"""Key frames that are compared with the first."""


@dataclass(frozen=True, kw_only=True)
class StaticCameraTest:
    """How far the background moves in the picture.

    Attributes:
        still: Whether the camera counts as standing.
        moved: The largest shift of the background between the first key frame and another, in
            longer sides of the picture (median over its points); NaN if it was lost.
    """

    is_static: bool
    background_motion: float


def detect_static_camera(keys: list[SfmKeyframe]) -> StaticCameraTest:
    """Follows points of the first key frame's background into others."""
    first = keys[0]
    pixels = detect_corners(first.gray, ~first.person_mask, MAX_CORNERS)
    longer, moved = max(first.gray.shape), 0.0
    if len(pixels) < MIN_TRACKED_POINTS:
        return StaticCameraTest(is_static=False, background_motion=float("nan"))
    rows = np.unique(np.linspace(1, len(keys) - 1, COMPARED_KEYFRAMES).round().astype(int))
    for key in (keys[int(row)] for row in rows):
        there, found = track_points(first.gray, key.gray, pixels)
        x, y = np.clip(pixels.astype(int).T, 0, np.array(key.gray.shape[::-1])[:, None] - 1)
        open_view = ~key.person_mask[y, x]
        found &= open_view
        if found.sum() < max(MIN_TRACKED_POINTS, MIN_TRACKED_FRACTION * open_view.sum()):
            return StaticCameraTest(is_static=False, background_motion=float("nan"))
        shift = float(np.median(np.linalg.norm(there - pixels, axis=1)[found])) / longer
        moved = max(moved, shift)
        if moved > MAX_STATIC_SHIFT:
            return StaticCameraTest(is_static=False, background_motion=moved)
    return StaticCameraTest(is_static=True, background_motion=moved)

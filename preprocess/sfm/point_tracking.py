"""Track points from image to image, and detect a static camera by them.

The tracker is that of Lucas & Kanade 1981, in pyramids (Bouguet 2000).
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from preprocess.sfm.sfm_keyframes import SfmKeyframe

WINDOW = (17, 17)
"""Size of the patch around a point, pixels."""

LEVELS = 4
"""Levels of the pyramid without a guess."""

LEVELS_WITH_GUESS = 3
"""Levels of the pyramid with a guess of where a point is."""

MAX_ROUND_TRIP_PX = 0.7
"""Largest distance of a point that was tracked there and back, pixels; beyond it is lost."""

GrayImage = UInt8[np.ndarray, "height width"]


def track_points(
    start: GrayImage,
    picture: GrayImage,
    pixels: Float[np.ndarray, "points 2"],
    guess: Float[np.ndarray, "points 2"] | None = None,
) -> tuple[Float[np.ndarray, "points 2"], Bool[np.ndarray, "points"]]:
    """Where points of one picture are in another, and which were found again.

    Args:
        start: The picture that the points were chosen in.
        picture: The other one.
        pixels: The points; the first pixel's centre is at (0.5, 0.5).
        guess: Where they may be in the other one; where they were, if None.
    """
    if not len(pixels):
        return pixels.copy(), np.zeros(0, dtype=bool)
    levels = LEVELS if guess is None else LEVELS_WITH_GUESS
    there, found = _optical_flow(start, picture, pixels, pixels if guess is None else guess, levels)
    back, again = _optical_flow(picture, start, there, pixels, levels)
    height, width = picture.shape
    inside = ((there > 0.0) & (there < (width, height))).all(axis=1)
    same = np.linalg.norm(back - pixels, axis=1) < MAX_ROUND_TRIP_PX
    return there, found & again & same & inside


def detect_corners(
    picture: GrayImage, free: Bool[np.ndarray, "height width"], most: int
) -> np.ndarray:
    """Points that can be followed, evenly spread (Shi & Tomasi 1994)."""
    spacing = max(4.0, 0.01 * max(picture.shape))
    found = cv2.goodFeaturesToTrack(picture, most, 0.01, spacing, mask=free.astype(np.uint8))
    if found is None:
        return np.zeros((0, 2))
    return found.reshape(-1, 2).astype(np.float64) + 0.5


def _optical_flow(
    start: GrayImage,
    picture: GrayImage,
    pixels: Float[np.ndarray, "points 2"],
    guess: Float[np.ndarray, "points 2"],
    levels: int,
) -> tuple[Float[np.ndarray, "points 2"], Bool[np.ndarray, "points"]]:
    """OpenCV's, whose first pixel's centre is at (0, 0)."""
    there, status, _ = cv2.calcOpticalFlowPyrLK(
        start, picture, (pixels - 0.5).astype(np.float32)[:, None],
        (guess - 0.5).astype(np.float32)[:, None].copy(), winSize=WINDOW, maxLevel=levels,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return there[:, 0].astype(np.float64) + 0.5, status[:, 0] > 0


MAX_CORNERS = 400
"""Most points of the background that are tracked."""

MIN_TRACKED_FRACTION = 0.3
"""Fraction of the points that must be tracked for a static camera."""

MAX_STATIC_SHIFT = 0.005
"""Largest shift of a static background; a fraction of the image's longer side (5 px of 960)."""

MIN_TRACKED_POINTS = 12
"""Fewest points that must be tracked for a static camera."""

COMPARED_KEYFRAMES = 12
"""Number of key frames that are compared with the first."""


@dataclass(frozen=True, kw_only=True)
class StaticCameraTest:
    """How far the background moves in the picture.

    Attributes:
        is_static: Whether the camera counts as standing.
        background_motion: Largest shift of the background between the first key frame and another
            (median over its points), as a fraction of the image's longer side; NaN if it was lost.
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

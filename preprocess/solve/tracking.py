"""Points followed from picture to picture (Lucas & Kanade 1981, in pyramids: Bouguet 2000)."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

WINDOW = (17, 17)
LEVELS, LEVELS_WITH_GUESS = 4, 3
MAX_ROUND_TRIP_PX = 0.7
"""A point that does not come back to where it came from was lost."""

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


def detect_corners(picture: GrayImage, free: Bool[np.ndarray, "height width"], most: int) -> np.ndarray:
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

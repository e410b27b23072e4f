"""Hair that stands off the head farther than clothes do: where it may be, and what is no leak."""

import cv2
import numpy as np
from jaxtyping import Bool, Float

from capture.camera import Camera

HEAD_JOINT = 15
"""The head's joint."""

HEAD_RADIUS_M, HAIR_BAND_M = 0.3, 0.06
"""So near to the head's middle, outside the shell at least so much is in doubt; what is found there
does not make a cut less trusted."""

MIN_HAIR_WIDTH_M = 0.025
"""What is so wide in all directions is a knot or a bun, however little the shell knows of it; what
is narrower may be a leak."""


def head_region(
    skin: Float[np.ndarray, "points 3"], camera: Camera, px_per_m: float
) -> Bool[np.ndarray, "height width"]:
    """The pixels that may be hair.

    Args:
        skin: The head's, in the world.
        camera: Of the picture.
        px_per_m: What a metre is in the picture, at the body.
    """
    x, y = camera.project(skin.mean(axis=0, keepdims=True))[0]
    width, height = camera.size_px
    across, down = np.arange(width) + 0.5 - x, np.arange(height) + 0.5 - y
    return across**2 + (down**2)[:, None] < (HEAD_RADIUS_M * px_per_m) ** 2


def solid_hair(
    protruding: Bool[np.ndarray, "height width"], px_per_m: float
) -> Bool[np.ndarray, "height width"]:
    """Of hair outside the shell what stands off in one piece, and the pixels beside it.

    Args:
        beyond: The pixels of hair outside the shell.
        px_per_m: What a metre is in the picture, at the body.
    """
    wide = np.ones((max(3, int(MIN_HAIR_WIDTH_M * px_per_m) | 1),) * 2, np.uint8)
    solid = cv2.morphologyEx(protruding.astype(np.uint8), cv2.MORPH_OPEN, wide)
    return cv2.dilate(solid, np.ones((3, 3), np.uint8)) > 0

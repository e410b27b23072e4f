"""Soft edges for a hard mask: how much of each border pixel is person, by the colours around it."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

NEAR_PX = 1.0
"""From how far around a border pixel the colours of person and background come (a Gaussian's σ)."""

EDGE_PX = 0.6
"""How wide the edge of a picture is: the σ of the lens and the pixel."""

APART = 60.0
"""Colours less far apart than this tell nothing; there the mask is only smoothed."""

TRUST = 0.5
"""How far colours are believed against the smoothed mask: thin stripes and hair deceive them."""


def softened(
    rgb: UInt8[np.ndarray, "height width 3"], person: Bool[np.ndarray, "height width"]
) -> Float32[np.ndarray, "height width"]:
    """The mask with the pixels along its border split between person and background.

    A pixel of the border is a mixture I = a F + (1 - a) B of the mean colours of person and
    background beside it, so a is the projection of I - B on F - B. It is averaged with the mask
    seen through a lens.
    """
    hard = person.astype(np.uint8)
    square = np.ones((3, 3), np.uint8)
    inside, touched = cv2.erode(hard, square), cv2.dilate(hard, square)
    border = (touched > 0) & (inside == 0)
    smooth = cv2.GaussianBlur(hard.astype(np.float32), (0, 0), EDGE_PX)
    picture = rgb.astype(np.float32)
    front, has_front = _around(picture, inside)
    back, has_back = _around(picture, 1 - touched)
    apart = front - back
    squared = (apart**2).sum(axis=-1)
    share = ((picture - back) * apart).sum(axis=-1) / np.maximum(squared, np.float32(1.0))
    mixed = TRUST * np.clip(share, 0.0, 1.0) + (1.0 - TRUST) * smooth
    tells = has_front & has_back & (squared > APART**2)
    alpha = np.where(tells, mixed, smooth)
    return np.where(border, alpha, hard).astype(np.float32)


def _around(
    picture: Float32[np.ndarray, "height width 3"], where: UInt8[np.ndarray, "height width"]
) -> tuple[Float32[np.ndarray, "height width 3"], Bool[np.ndarray, "height width"]]:
    """Mean colour of the chosen pixels around each pixel, and whether there are any."""
    chosen = where.astype(np.float32)
    weight = cv2.GaussianBlur(chosen, (0, 0), NEAR_PX)
    total = cv2.GaussianBlur(picture * chosen[..., None], (0, 0), NEAR_PX)
    return total / np.maximum(weight, np.float32(1e-6))[..., None], weight > 1e-4

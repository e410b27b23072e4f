"""Soft edges for a hard mask: how much of each border pixel is person, by the colours around it."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

LOCAL_COLOR_PX = 1.0
"""From how far around a border pixel the colours of person and background come (a Gaussian's σ)."""

EDGE_SIGMA_PX = 0.5
"""How wide the edge of a picture is: the σ of the lens and the pixel."""

COLOR_CONTRAST = 20.0, 45.0
"""AppearanceModel less far apart than the first tell nothing; there the mask is only smoothed. From the
second on they tell all they can."""

MAX_COLOR_WEIGHT = 0.5
"""How far colours are believed against the smoothed mask: thin stripes and hair deceive them."""

CROP_MARGIN_PX = 8
"""So far around the person pixels are looked at."""

MIXTURE_RESIDUAL = 30.0
"""A pixel whose colour is this far from all mixtures of both is believed half as much."""


def soften_border(
    rgb: UInt8[np.ndarray, "height width 3"], mask: Bool[np.ndarray, "height width"]
) -> Float32[np.ndarray, "height width"]:
    """The mask with the pixels along its border split between person and background.

    A pixel of the border is a mixture I = a F + (1 - a) B of the mean colours of person and
    background beside it, so a is the projection of I - B on F - B. It is averaged with the mask
    seen through a lens, and counts less where F and B are alike or I is no mixture of them.
    """
    hard = mask.astype(np.uint8)
    left, top, width, height = cv2.boundingRect(hard)
    around = np.s_[max(top - CROP_MARGIN_PX, 0) : top + height + CROP_MARGIN_PX,
                   max(left - CROP_MARGIN_PX, 0) : left + width + CROP_MARGIN_PX]  # fmt: skip
    alpha = hard.astype(np.float32)
    alpha[around] = _soften_crop(rgb[around], np.ascontiguousarray(hard[around]))
    return alpha


def _soften_crop(
    rgb: UInt8[np.ndarray, "height width 3"], hard: UInt8[np.ndarray, "height width"]
) -> Float32[np.ndarray, "height width"]:
    square = np.ones((3, 3), np.uint8)
    inside, touched = cv2.erode(hard, square), cv2.dilate(hard, square)
    border = (touched > 0) & (inside == 0)
    smooth = cv2.GaussianBlur(hard.astype(np.float32), (0, 0), EDGE_SIGMA_PX)
    picture = rgb.astype(np.float32)
    front, has_front = _local_mean_color(picture, inside)
    back, has_back = _local_mean_color(picture, 1 - touched)
    apart = front - back
    squared = (apart**2).sum(axis=-1)
    share = ((picture - back) * apart).sum(axis=-1) / np.maximum(squared, np.float32(1.0))
    beside = np.abs(picture - back - share[..., None] * apart).max(axis=-1)
    low, high = COLOR_CONTRAST[0] ** 2, COLOR_CONTRAST[1] ** 2
    trust = MAX_COLOR_WEIGHT * np.clip((squared - low) / (high - low), 0.0, 1.0)
    trust *= np.clip(1.5 - beside / MIXTURE_RESIDUAL, 0.0, 1.0) * (has_front & has_back)
    alpha = trust * np.clip(share, 0.0, 1.0) + (1.0 - trust) * smooth
    return np.where(border, alpha, hard).astype(np.float32)


def _local_mean_color(
    picture: Float32[np.ndarray, "height width 3"], selected: UInt8[np.ndarray, "height width"]
) -> tuple[Float32[np.ndarray, "height width 3"], Bool[np.ndarray, "height width"]]:
    """Mean colour of the chosen pixels around each pixel, and whether there are any."""
    chosen = selected.astype(np.float32)
    weight = cv2.GaussianBlur(chosen, (0, 0), LOCAL_COLOR_PX)
    total = cv2.GaussianBlur(picture * chosen[..., None], (0, 0), LOCAL_COLOR_PX)
    return total / np.maximum(weight, np.float32(1e-6))[..., None], weight > 1e-4

"""What stands behind an avatar: a colour by its name, a picture, or nothing."""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import ImageColor

from capture.errors import InputError
from capture.images import read_image

Compositor = Callable[[UInt8[np.ndarray, "height width 4"]], UInt8[np.ndarray, "height width 3"]]
TRANSPARENT = "transparent"


def background_compositor(color_or_path: str) -> Compositor:
    """A function that puts pictures with straight alpha on a background.

    Args:
        wish: A colour ("white", "#203040", "rgb(10, 20, 30)") or the path of a picture, which is
            cropped in the middle to the shape that is needed.

    Raises:
        InputError: If it is neither.
    """
    try:
        color = np.array(ImageColor.getrgb(color_or_path)[:3], dtype=np.uint8)
    except ValueError:
        color = None
    if color is not None:
        return lambda rgba: _composite_over(rgba, np.broadcast_to(color, (*rgba.shape[:2], 3)))
    path = Path(color_or_path)
    if not path.is_file():
        raise InputError(
            f"--background {color_or_path} is neither a colour (white, #203040), nor {TRANSPARENT}, nor a "
            "picture that is there."
        )
    picture, _ = read_image(path)
    fitted = lru_cache(1)(lambda width, height: _crop_to_cover(picture, width, height))
    return lambda rgba: _composite_over(rgba, fitted(rgba.shape[1], rgba.shape[0]))


def _composite_over(
    rgba: UInt8[np.ndarray, "height width 4"], behind: UInt8[np.ndarray, "height width 3"]
) -> UInt8[np.ndarray, "height width 3"]:
    alpha = rgba[..., 3:].astype(np.uint16)
    mixed = rgba[..., :3] * alpha + behind * (255 - alpha) + 127
    return (mixed // 255).astype(np.uint8)


def _crop_to_cover(
    picture: UInt8[np.ndarray, "_ _ 3"], width: int, height: int
) -> UInt8[np.ndarray, "height width 3"]:
    rows, columns = picture.shape[:2]
    scale = max(width / columns, height / rows)
    wide, high = max(width, round(columns * scale)), max(height, round(rows * scale))
    how = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    scaled = cv2.resize(picture, (wide, high), interpolation=how)
    left, top = (wide - width) // 2, (high - height) // 2
    return scaled[top : top + height, left : left + width]

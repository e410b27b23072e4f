"""Images as WebP in data URIs, for self-contained pages."""

import base64
import io
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image


def to_uint8(
    picture: Float[np.ndarray, "height width channels"],
) -> UInt8[np.ndarray, "height width channels"]:
    """Round an image in [0, 1] to 8 bits."""
    return (np.clip(picture, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def webp_data_uri(picture: UInt8[np.ndarray, "height width channels"]) -> str:
    """Encode an RGB or RGBA image as a data URI."""
    return _encode_webp([picture], frame_ms=0)


def animated_webp_data_uri(
    pictures: Sequence[UInt8[np.ndarray, "height width channels"]], *, fps: float
) -> str:
    """Encode RGB or RGBA images as a looping animation in a data URI."""
    return _encode_webp(pictures, frame_ms=max(1, round(1000.0 / fps)))


def _encode_webp(pictures: Sequence[UInt8[np.ndarray, "..."]], *, frame_ms: int) -> str:
    first, *others = [Image.fromarray(picture) for picture in pictures]
    buffer = io.BytesIO()
    moving = {"save_all": True, "append_images": others, "duration": frame_ms, "loop": 0}
    first.save(buffer, format="WEBP", quality=82, method=3, **(moving if others else {}))
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")

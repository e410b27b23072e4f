"""Pictures inside a page: encoded as WebP, in the address itself."""

import base64
import io
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image


def to_uint8(
    picture: Float[np.ndarray, "height width channels"],
) -> UInt8[np.ndarray, "height width channels"]:
    """A picture in [0, 1] as bytes."""
    return (np.clip(picture, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def webp_data_uri(picture: UInt8[np.ndarray, "height width channels"]) -> str:
    """One RGB or RGBA picture."""
    return _encode_webp([picture], frame_ms=0)


def animated_webp_data_uri(
    pictures: Sequence[UInt8[np.ndarray, "height width channels"]], *, fps: float
) -> str:
    """Pictures that follow each other again and again; transparency stays."""
    return _encode_webp(pictures, frame_ms=max(1, round(1000.0 / fps)))


def _encode_webp(pictures: Sequence[UInt8[np.ndarray, "..."]], *, frame_ms: int) -> str:
    first, *others = [Image.fromarray(picture) for picture in pictures]
    buffer = io.BytesIO()
    moving = {"save_all": True, "append_images": others, "duration": frame_ms, "loop": 0}
    first.save(buffer, format="WEBP", quality=82, method=3, **(moving if others else {}))
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")

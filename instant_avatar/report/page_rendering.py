"""Self-contained pages: templates of this folder filled in, and images as data URIs."""

import base64
import io
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image

from instant_avatar.report.report_schema import format_percent, format_psnr


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("instant_avatar", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"psnr": format_psnr, "percent": format_percent}
    return environment


def render_template(template: str, **values: Any) -> Markup:
    """Fill in a template; plain text is escaped, what another template has made is not."""
    return Markup(_environment().get_template(template).render(values))


def to_uint8(
    picture: Float[np.ndarray, "height width channels"],
) -> UInt8[np.ndarray, "height width channels"]:
    """Round an image in [0, 1] to 8 bits."""
    return (np.clip(picture, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def encode_webp(
    pictures: Sequence[UInt8[np.ndarray, "height width channels"]], *, fps: float
) -> bytes:
    """Encode RGB or RGBA images as WebP; several are a looping animation."""
    first, *others = [Image.fromarray(picture) for picture in pictures]
    frame_ms, buffer = max(1, round(1000.0 / fps)), io.BytesIO()
    moving = {"save_all": True, "append_images": others, "duration": frame_ms, "loop": 0}
    one_key_frame = {"kmin": len(others), "kmax": len(others) + 1}  # the first
    options = {"method": 1, **moving, **one_key_frame} if others else {"method": 3}
    first.save(buffer, format="WEBP", quality=82, **options)
    return buffer.getvalue()


def data_uri(webp: bytes) -> str:
    """Return the content of a WebP file as a data URI."""
    return "data:image/webp;base64," + base64.b64encode(webp).decode("ascii")


def webp_data_uri(picture: UInt8[np.ndarray, "height width channels"]) -> str:
    """Encode an RGB or RGBA image as a data URI."""
    return data_uri(encode_webp([picture], fps=1.0))

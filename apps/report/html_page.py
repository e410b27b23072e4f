"""Parts of self-contained HTML pages: head with style, sections, tables, images as data URIs."""

import base64
import io
from collections.abc import Sequence
from html import escape
from importlib.resources import files

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image


def html_page(title: str, body: str, *, style: str = "") -> str:
    """Return a whole page in the style of page.css.

    Args:
        title: Plain text.
        body: HTML.
        style: More rules of CSS.
    """
    style = (files("apps") / "report" / "page.css").read_text(encoding="utf-8") + style
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n"
        f"<body>\n{body}\n</body>\n</html>\n"
    )


def html_section(heading: str, content: str) -> str:
    """Return content under a heading; nothing without content."""
    return f"<h2>{heading}</h2>\n{content}" if content else ""


def html_note(text: str) -> str:
    """Return a small paragraph of plain text; nothing without text."""
    return f'<p class="legend">{escape(text)}</p>' if text else ""


def html_table(lines: Sequence[Sequence[str]], *, header: bool = True) -> str:
    """Return lines of plain cells as a table; nothing without lines below the header.

    Args:
        lines: Cells of each line.
        header: Whether the first line is the header.
    """
    if len(lines) <= header:
        return ""
    rows = ["".join(f"<td>{escape(cell)}</td>" for cell in line) for line in lines]
    if header:
        rows[0] = rows[0].replace("td>", "th>")
    return f"<table>{''.join(f'<tr>{row}</tr>' for row in rows)}</table>"


def to_uint8(
    picture: Float[np.ndarray, "height width channels"],
) -> UInt8[np.ndarray, "height width channels"]:
    """Round an image in [0, 1] to 8 bits."""
    return (np.clip(picture, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def webp_data_uri(picture: UInt8[np.ndarray, "height width channels"]) -> str:
    """Encode an RGB or RGBA image as a data URI."""
    return animated_webp_data_uri([picture], fps=1.0)


def animated_webp_data_uri(
    pictures: Sequence[UInt8[np.ndarray, "height width channels"]], *, fps: float
) -> str:
    """Encode RGB or RGBA images as a data URI; several are a looping animation."""
    first, *others = [Image.fromarray(picture) for picture in pictures]
    frame_ms, buffer = max(1, round(1000.0 / fps)), io.BytesIO()
    moving = {"save_all": True, "append_images": others, "duration": frame_ms, "loop": 0}
    first.save(buffer, format="WEBP", quality=82, method=3, **(moving if others else {}))
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")

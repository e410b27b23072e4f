"""The frame of self-contained HTML pages: head with style, sections and tables."""

from collections.abc import Sequence
from html import escape
from importlib.resources import files


def html_page(title: str, body: str) -> str:
    """Return a whole page in the style of page.css.

    Args:
        title: Plain text.
        body: HTML.
    """
    style = (files("apps") / "report" / "page.css").read_text(encoding="utf-8")
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n"
        f"<body>\n{body}\n</body>\n</html>\n"
    )


def html_section(heading: str, content: str) -> str:
    """Return content under a heading; nothing without content."""
    return f"<h2>{heading}</h2>\n{content}" if content else ""


def html_table(lines: Sequence[Sequence[str]]) -> str:
    """Return lines of plain cells as a table; the first is its header."""
    header, *rest = ("".join(f"<td>{escape(cell)}</td>" for cell in line) for line in lines)
    rows = "".join(f"<tr>{line}</tr>" for line in rest)
    head = header.replace("td>", "th>")
    return f'<div class="card scores"><table><tr>{head}</tr>{rows}</table></div>'

"""report.html: the values of a report, figures and images as one self-contained page."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from markupsafe import Markup

from instant_avatar.report.page_rendering import render_template
from instant_avatar.report.report_schema import Report

SHOWN_VALUES = ("frames", "training", "held_out", "stream", "package", "machine")
"""Parts of the report that are listed value by value."""


@dataclass(frozen=True, kw_only=True)
class ComparisonPair:
    """A held-out frame and its rendering as data URIs; `psnr` of the whole image, dB."""

    frame: int
    psnr: float
    verdict: str | None
    truth: str
    render: str


def report_page(
    report: Report,
    *,
    name: str,
    verdict: str,
    body_map: Markup | str = "",
    pairs: Sequence[ComparisonPair] = (),
    animation: str | None = None,
    warnings: Sequence[str] = (),
    notes: Sequence[str] = (),
    present_files: Collection[str] = (),
    next_steps: Mapping[str, str] | None = None,
) -> str:
    """Return the page as HTML.

    Args:
        verdict: The verdict on the avatar, and what would make it better.
        body_map: SVG of the body coverage (`CoverageMap.svg`).
        animation: Animation of novel poses as a data URI.
        warnings: What asks the user for something; `notes` ask for nothing.
        present_files: Names of the files next to the page; the page refers to no others.
        next_steps: Commands by what they do.
    """
    content = asdict(report)
    return render_template(
        "report.html",
        title=f"{name}: avatar",
        name=name,
        verdict=verdict,
        report=report,
        frames=report.frames.sentence(),
        body_map=body_map,
        pairs=pairs,
        animation=animation,
        warnings=warnings,
        notes=notes,
        present_files=present_files,
        next_steps=next_steps or {},
        values=list(_flatten({key: content[key] for key in SHOWN_VALUES})),
        recipe=list(_flatten(content["recipe"])),
        command=list(_flatten(content["command"])),
    )


def _flatten(content: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    """Yield dotted names and formatted values; lists of records are skipped."""
    for key, value in content.items():
        name = f"{above}{key}".replace("_", " ")
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{above}{key}.")
        elif isinstance(value, list | tuple):
            if not (value and isinstance(value[0], Mapping)):
                yield name, ", ".join(str(item) for item in value) or "none"
        elif isinstance(value, float):
            yield name, f"{value:,.4g}" if abs(value) < 1000 else f"{value:,.0f}"
        else:
            yield name, "n/a" if value is None else str(value)

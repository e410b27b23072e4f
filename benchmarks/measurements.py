"""What was measured beside what was asked for, as one table."""

import json
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from baselines.hardware import Hardware


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """One figure.

    Attributes:
        name: What was measured, with its unit.
        value: None where there is none.
        required, stretch_goal: What was asked for; empty where nothing was.
        context: What to read it beside.
    """

    name: str
    value: float | None
    required: str = ""
    stretch_goal: str = ""
    context: str = ""


def print_measurements(
    measurements: Iterable[Measurement], path: Path | None, title: str = ""
) -> None:
    """Print each on standard error as soon as it is known, then all as a table; write them to path.

    Args:
        measurements: Measured while they are iterated.
        path: JSON file; None for none.
        title: What all of them were measured on.
    """
    hardware, marks = Hardware.here(), list[Measurement]()
    for mark in measurements:
        print(f"{mark.name}: {mark.value} ({mark.context})", file=sys.stderr, flush=True)
        marks.append(mark)
    print("\n".join([*hardware.lines(), title, "", *markdown_rows(marks)]))
    if path is not None:
        content = {"hardware": asdict(hardware), "title": title}
        content["marks"] = [asdict(mark) for mark in marks]
        path.write_text(json.dumps(content, indent=1) + "\n")


def markdown_rows(marks: list[Measurement]) -> list[str]:
    """The marks as Markdown."""
    cells = [("what", "measured", "at least", "moonshot", "beside it")]
    cells += [(m.name, format_value(m.value), m.required, m.stretch_goal, m.context) for m in marks]
    *widths, _ = (max(map(len, column)) for column in zip(*cells, strict=True))
    lines = [
        "| " + " | ".join([a.ljust(widths[0]), b.rjust(widths[1]), c.ljust(widths[2]),
                           d.ljust(widths[3]), e]) + " |"
        for a, b, c, d, e in cells
    ]  # fmt: skip
    rule = ["-" * (width + 2) for width in widths]
    rule[1] = rule[1][:-1] + ":"
    return [lines[0], "|" + "|".join(rule) + "|---|", *lines[1:]]


def format_value(value: float | None) -> str:
    """A number with as many digits as anybody reads."""
    if value is None:
        return "-"
    digits = 0 if abs(value) >= 100 else 1 if abs(value) >= 10 else 2 if abs(value) >= 0.1 else 3
    return f"{value:,.{digits}f}"

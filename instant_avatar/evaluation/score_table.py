"""Scores of an avatar by renderer, poses and background: a Markdown table, and JSON."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from avatar.evaluation.image_metrics import SharpnessVerdict, overall_verdict
from avatar.evaluation.perceptual import LPIPS_CONVENTIONS
from instant_avatar.evaluation.frame_scoring import METRICS, FrameScore, ShownFrame
from instant_avatar.report.report_schema import finite_mean, to_json_value


@dataclass(frozen=True, kw_only=True)
class ScoreRow:
    """Scores of one renderer with one kind of poses, on one background.

    Attributes:
        renderer: "renderer", "player hq" or "player lite".
        poses: "given" or "fitted".
        background: "white" or "black".
    """

    renderer: str
    poses: str
    background: str = "white"
    scores: list[FrameScore] = field(default_factory=list)

    @property
    def way(self) -> tuple[str, str, str]:
        """Renderer, poses and background."""
        return self.renderer, self.poses, self.background

    def mean_of(self, name: str) -> float | None:
        """Return the mean of one of `METRICS` over the frames; None without finite values."""
        return finite_mean([score.as_json().get(name, math.nan) for score in self.scores])

    @property
    def verdict(self) -> SharpnessVerdict | None:
        """Verdict on the frames; None without a silhouette."""
        return overall_verdict(self.scores)

    def as_json(self) -> dict[str, Any]:
        """Return means, then the scores of every frame."""
        return {
            "renderer": self.renderer,
            "poses": self.poses,
            "background": self.background,
            **{name: self.mean_of(name) for name in METRICS},
            "verdict": self.verdict,
            "frames": [score.as_json() for score in self.scores],
        }


@dataclass(frozen=True, kw_only=True)
class AvatarEvaluation:
    """Scores of an avatar on a capture.

    Attributes:
        size: Width and height of the images; None without any.
        paper: Scores in the paper, if the subject is in it.
        dances: Animations of novel poses as data URIs, by name.
    """

    name: str
    capture: str
    size: tuple[int, int] | None
    rows: Sequence[ScoreRow]
    paper: dict[str, float] | None = None
    shown: Sequence[ShownFrame] = ()
    report: dict[str, Any] | None = None
    dances: dict[str, str] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """Return the scores as JSON."""
        return {
            "avatar": self.name,
            "capture": self.capture,
            "size": self.size,
            "rows": [row.as_json() for row in self.rows],
            "paper": self.paper,
        }


def evaluations_to_json(
    evaluations: Sequence[AvatarEvaluation], conditions: Mapping[str, str]
) -> str:
    """Return the content of the file for --json."""
    avatars = [each.as_json() for each in evaluations]
    content = {"format": 2, "conditions": conditions, "avatars": avatars}
    return json.dumps(to_json_value(content), indent=1, allow_nan=False) + "\n"


TEXT_COLUMNS = ("avatar", "drawn by", "poses", "on", "looks")
"""Columns of the table that are left-aligned."""
COLUMNS = {
    "psnr": ("PSNR", ".2f"),
    "psnr_box": ("in the box", ".2f"),
    "psnr_mask": ("in the mask", ".2f"),
    "ssim": ("SSIM", ".4f"),
}
"""Heading and format of each metric in the table, but those of LPIPS and time."""
PAPER_ROW_NAME = "InstantAvatar (paper)"
"""Renderer of the rows with the paper's scores."""
NOT_MEASURED = "n/a"


def table_cells(evaluations: Sequence[AvatarEvaluation]) -> list[list[str]]:
    """Return the header, all rows of all avatars, and their means over several avatars."""
    rows = [row for each in evaluations for row in each.rows]
    lpips = {
        f"lpips_{name}": (convention.label, ".4f")
        for name, convention in LPIPS_CONVENTIONS.items()
        if any(name in score.lpips for row in rows for score in row.scores)
    }
    columns = COLUMNS | (lpips or {"lpips": ("LPIPS", ".4f")}) | {"cpu_ms": ("ms", ".0f")}
    headings = [heading for heading, _ in columns.values()]
    lines = [["avatar", "frames", "drawn by", "poses", "on", *headings, "looks"]]

    def add(name: str, frames: str, way: Sequence[str], means: Mapping[str, float | None]) -> None:
        cells = [
            _format_cell(metric, means.get(metric), form) for metric, (_, form) in columns.items()
        ]
        lines.append([name, frames, *way, *cells])

    def means_of(row: ScoreRow) -> dict[str, float | None]:
        return {metric: row.mean_of(metric) for metric in columns}

    for each in evaluations:
        for row in each.rows:
            add(each.name, str(len(row.scores)), row.way, means_of(row))
            lines[-1].append(row.verdict or "")
        if each.paper is not None:
            add(each.name, "", (PAPER_ROW_NAME, "fitted", "white"), each.paper)
            lines[-1].append("")
    for first in evaluations[0].rows if len(evaluations) > 1 else ():
        alike = [row for row in rows if row.way == first.way]
        if len(alike) == len(evaluations):  # all avatars have such a row
            means = [means_of(row) for row in alike]
            overall = {
                metric: finite_mean([mean for each in means if (mean := each[metric]) is not None])
                for metric in columns
            }
            add("mean", str(sum(len(row.scores) for row in alike)), first.way, overall)
            lines[-1].append("")
    return lines


def markdown_table(evaluations: Sequence[AvatarEvaluation]) -> str:
    """Return `table_cells` as aligned Markdown."""
    header, *lines = table_cells(evaluations)
    columns = list(zip(header, *lines, strict=True))
    widths = [max(3, *map(len, column)) for column in columns]
    is_text = [name in TEXT_COLUMNS for name in header]
    rule = [
        "-" * width if text else "-" * (width - 1) + ":"
        for width, text in zip(widths, is_text, strict=True)
    ]
    padded = [
        [
            cell.ljust(width) if text else cell.rjust(width)
            for cell, width, text in zip(line, widths, is_text, strict=True)
        ]
        for line in (header, rule, *lines)
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in padded) + "\n"


def _format_cell(metric: str, value: float | None, form: str) -> str:
    if value is not None:
        return format(value, form)
    return NOT_MEASURED if metric.startswith("lpips") else ""

"""Scores of an avatar by renderer, poses and background: a Markdown table, CSV and JSON."""

import csv
import io
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from apps.evaluation.frame_scoring import METRICS, FrameScore, ShownFrame
from apps.report.report_schema import finite_mean, to_json_value
from avatar.evaluation.image_metrics import SharpnessVerdict, overall_verdict
from avatar.evaluation.perceptual import LPIPS_CONVENTIONS


@dataclass(frozen=True, kw_only=True)
class ScoreRow:
    """Scores of one renderer with one kind of poses, on one background.

    Attributes:
        renderer: "renderer", "player hq", "player lite", or "pictures" of another system.
        poses: "given", "fitted", or "theirs" of pictures.
        background: "white" or "black".
        scores: Scores of each frame.
    """

    renderer: str
    poses: str
    background: str = "white"
    scores: list[FrameScore] = field(default_factory=list)

    def mean_of(self, name: str) -> float | None:
        """Return the mean of one of `METRICS` over the frames; None without finite values."""
        return finite_mean([score.value(name) for score in self.scores])

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
            "frames": [
                {key: value for key, value in vars(score).items() if key != "others"}
                | dict(score.others)
                for score in self.scores
            ],
        }


@dataclass(frozen=True, kw_only=True)
class AvatarEvaluation:
    """Scores of an avatar on a capture.

    Attributes:
        name: Name of the avatar in the table.
        capture: Path of the video.
        size: Width and height of the images; None without any.
        rows: Scores by renderer and poses, at least one.
        paper: Scores in the paper, if the subject is in it.
        shown: Frames with their renderings, for the card.
        report: Content of the run's report.json, if there is one.
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
    evaluations: Iterable[AvatarEvaluation], conditions: dict[str, str] | None = None
) -> str:
    """Return the content of the file for --json."""
    avatars = [each.as_json() for each in evaluations]
    content = {"format": 2, "conditions": conditions or {}, "avatars": avatars}
    return json.dumps(to_json_value(content), indent=1, allow_nan=False) + "\n"


def evaluations_to_csv(evaluations: Iterable[AvatarEvaluation]) -> str:
    """Return one line per row with the mean of every metric; empty where it was not measured."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    ways = ("avatar", "capture", "width", "height", "renderer", "poses", "background", "frames")
    writer.writerow([*ways, *METRICS, "verdict"])
    for each in evaluations:
        for row in each.rows:
            means = [row.mean_of(metric) for metric in METRICS]
            writer.writerow(
                [
                    each.name, each.capture, *(each.size or ("", "")), row.renderer, row.poses,
                    row.background, len(row.scores),
                    *("" if mean is None else f"{mean:.6g}" for mean in means), row.verdict or "",
                ]
            )  # fmt: skip
    return text.getvalue()


TEXT_COLUMNS = ("avatar", "drawn by", "poses", "on", "looks", "clock", "region")
"""Columns of tables that are left-aligned."""
FORMATS = {"psnr": ".2f", "psnr_box": ".2f", "psnr_mask": ".2f", "ssim": ".4f"}
"""Format of each metric in the table, but those of LPIPS and time."""
HEADINGS = {"psnr": "PSNR", "psnr_box": "in the box", "psnr_mask": "in the mask", "ssim": "SSIM"}
"""Heading of each of them."""
PAPER_ROW_NAME = "InstantAvatar (paper)"
"""Renderer of the rows with the paper's scores."""
NOT_MEASURED = "n/a"


def table_cells(evaluations: Sequence[AvatarEvaluation]) -> list[list[str]]:
    """Return the header, all rows of all avatars, and their means over several avatars."""
    lpips = [
        f"lpips_{name}"
        for name in LPIPS_CONVENTIONS
        if any(row.mean_of(f"lpips_{name}") is not None for e in evaluations for row in e.rows)
    ]
    formats = FORMATS | dict.fromkeys(lpips or ["lpips"], ".4f") | {"cpu_ms": ".0f"}
    labels = [LPIPS_CONVENTIONS[name.removeprefix("lpips_")].label for name in lpips] or ["LPIPS"]
    ways = ["avatar", "frames", "drawn by", "poses", "on"]
    lines = [[*ways, *HEADINGS.values(), *labels, "ms", "looks"]]
    for each in evaluations:
        for row in each.rows:
            way = [each.name, str(len(row.scores)), row.renderer, row.poses, row.background]
            figures = {metric: row.mean_of(metric) for metric in formats}
            lines.append([*way, *_format_cells(figures, formats), row.verdict or ""])
        if each.paper is not None:
            figures = {metric: each.paper.get(metric) for metric in formats}
            way = [each.name, "", PAPER_ROW_NAME, "fitted", "white"]
            lines.append([*way, *_format_cells(figures, formats), ""])
    if len(evaluations) > 1:
        lines += _mean_rows(evaluations, formats)
    return lines


def markdown_table(evaluations: Sequence[AvatarEvaluation]) -> str:
    """Return `table_cells` as aligned Markdown."""
    return align_markdown(table_cells(evaluations))


def align_markdown(lines: Sequence[Sequence[str]]) -> str:
    """Return lines of cells, the first of which is the header, as aligned Markdown."""
    header = lines[0]
    widths = [max(3, *(len(line[column]) for line in lines)) for column in range(len(header))]
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
        for line in lines
    ]
    drawn = [padded[0], rule, *padded[1:]]
    return "\n".join(f"| {' | '.join(line)} |" for line in drawn) + "\n"


def _mean_rows(evaluations: Sequence[AvatarEvaluation], formats: dict[str, str]) -> list[list[str]]:
    """Return the mean over avatars for each kind of row that all of them have."""
    lines = []
    for first in evaluations[0].rows:
        way = (first.renderer, first.poses, first.background)
        alike = [
            row
            for each in evaluations
            for row in each.rows
            if (row.renderer, row.poses, row.background) == way
        ]
        if len(alike) != len(evaluations):
            continue
        figures = {
            metric: finite_mean(
                [math.nan if (mean := row.mean_of(metric)) is None else mean for row in alike]
            )
            for metric in formats
        }
        frames = str(sum(len(row.scores) for row in alike))
        lines.append(["mean", frames, *way, *_format_cells(figures, formats), ""])
    return lines


def _format_cells(figures: dict[str, float | None], formats: dict[str, str]) -> list[str]:
    return [
        format(value, form) if (value := figures[metric]) is not None else _blank(metric)
        for metric, form in formats.items()
    ]


def _blank(metric: str) -> str:
    return NOT_MEASURED if metric.startswith("lpips") else ""

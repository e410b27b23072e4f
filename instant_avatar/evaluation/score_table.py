"""Scores of an avatar by renderer, poses and background: a Markdown table, and JSON."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

import numpy as np
from jaxtyping import Float

from avatar.evaluation.image_metrics import SharpnessVerdict, overall_verdict
from avatar.evaluation.perceptual import LPIPS_CONVENTIONS, Lpips
from capture.hardware import describe_machine
from instant_avatar.evaluation.frame_scoring import (
    LARGEST_SHOWN_ERROR,
    METRICS,
    FrameScore,
    ShownFrame,
    choose_shown,
)
from instant_avatar.report.page_rendering import render_template
from instant_avatar.report.report_schema import finite_mean, to_json_value


@dataclass(frozen=True, kw_only=True)
class ScoreRow:
    """Scores of one renderer with one kind of poses, on one background.

    Attributes:
        renderer: "renderer", "player hq" or "player lite".
        poses: "given" or "tracked", and fitted before training; or "fitted" to each frame.
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

    @property
    def kind(self) -> tuple[str, bool, str]:
        """Renderer, whether poses are fitted to each frame, and background."""
        return self.renderer, self.poses == "fitted", self.background

    @property
    def mask_psnr(self) -> dict[int, float]:
        """PSNR in the mask by frame, as far as it is finite."""
        values = {score.frame: score.psnr_mask for score in self.scores}
        return {frame: value for frame, value in values.items() if math.isfinite(value)}

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
        paper: Scores in the paper of a dataset's subject, empty if it is not in it; None for other
            runs.
    """

    name: str
    capture: str
    size: tuple[int, int] | None
    rows: Sequence[ScoreRow]
    paper: dict[str, float] | None = None
    shown: Sequence[ShownFrame] = ()
    report: dict[str, Any] | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the scores as JSON."""
        return {
            "avatar": self.name,
            "capture": self.capture,
            "size": self.size,
            "rows": [row.as_json() for row in self.rows],
            "paper": self.paper or None,
        }


def evaluations_to_json(
    evaluations: Sequence[AvatarEvaluation], conditions: Mapping[str, str]
) -> str:
    """Return the content of the file for --json."""
    avatars = [each.as_json() for each in evaluations]
    content = {"format": 2, "conditions": conditions, "avatars": avatars}
    return json.dumps(to_json_value(content), indent=1, allow_nan=False) + "\n"


COLUMNS = {
    "psnr": ("PSNR", ".2f"),
    "psnr_box": ("in the box", ".2f"),
    "psnr_mask": ("in the mask", ".2f"),
    "ssim": ("SSIM", ".4f"),
}
"""Heading and format of each metric in the table, but those of LPIPS and time."""


def table_cells(evaluations: Sequence[AvatarEvaluation]) -> list[list[str]]:
    """Return the header, all rows of all avatars, and the means over the subjects of a dataset."""
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
        if each.paper:
            add(each.name, "", ("InstantAvatar (paper)", "fitted", "white"), each.paper)
            lines[-1].append("")
    is_dataset = len(evaluations) > 1 and all(each.paper is not None for each in evaluations)
    for first in evaluations[0].rows if is_dataset else ():
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
    """Return `table_cells` as aligned Markdown, and `compare_avatars` below."""
    header, *lines = table_cells(evaluations)
    columns = list(zip(header, *lines, strict=True))
    widths = [max(3, *map(len, column)) for column in columns]
    is_text = [name in ("avatar", "drawn by", "poses", "on", "looks") for name in header]
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
    comparison = compare_avatars(evaluations)
    below = [] if comparison is None else ["", comparison]
    return "\n".join([*(f"| {' | '.join(line)} |" for line in padded), *below]) + "\n"


def compare_avatars(evaluations: Sequence[AvatarEvaluation]) -> str | None:
    """Say which avatar is better, by how much, and if that is more than chance.

    Return None for subjects of a dataset, who differ, and for avatars without scores of one kind.
    Frames that both have drawn are compared in pairs.
    """
    if len(evaluations) < 2 or any(each.paper is not None for each in evaluations):
        return None
    scored = [{row.kind: row for row in each.rows if row.mask_psnr} for each in evaluations]
    kinds = [kind for kind in scored[0] if all(kind in each for each in scored)]
    if not kinds:
        return None
    kind = min(kinds, key=lambda kind: not kind[1])  # poses fitted to each frame, if there are any
    means = [float(np.mean([*each[kind].mask_psnr.values()])) for each in scored]
    first, second = np.argsort(means)[::-1][:2]
    rows, (best, other) = [each[kind] for each in scored], (evaluations[first], evaluations[second])
    ours, theirs = rows[first].mask_psnr, rows[second].mask_psnr
    shared = sorted(ours.keys() & theirs.keys()) if best.capture == other.capture else []
    if len(shared) > 1:
        gains = np.array([ours[frame] - theirs[frame] for frame in shared])
        gain, error = float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(len(gains)))
        frames = f"on the same {len(shared)} frames"
    else:
        parts = [np.array([*each.values()]) for each in (ours, theirs)]
        gain, error = means[first] - means[second], math.hypot(*map(_standard_error, parts))
        frames = "on frames of different captures or moments"
    if gain < 0.0:
        best, other, gain = other, best, -gain
    how = f"{gain:.2f} dB in the mask ({rows[first].renderer}, {rows[first].poses} poses, {frames}"
    if gain > 2.0 * error:
        return f"{best.name} is better than {other.name} by {how}; standard error {error:.2f} dB)."
    return (
        f"No clear difference: {best.name} is above {other.name} by {how}; standard error "
        f"{error:.2f} dB)."
    )


def _standard_error(values: Float[np.ndarray, "frames"]) -> float:
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else math.inf


def _format_cell(metric: str, value: float | None, form: str) -> str:
    if value is not None:
        return format(value, form)
    return "n/a" if metric.startswith("lpips") else ""


POSES = {
    "given": "given (in a file, fitted before training)",
    "tracked": "tracked (by ia-ingest in the video, fitted before training)",
    "fitted": "fitted (to each scored frame, with its exposure; the avatar is frozen)",
}
"""Kinds of poses, for the reader of the page."""


def evaluation_conditions(evaluations: Sequence[AvatarEvaluation], lpips: Lpips) -> dict[str, str]:
    """Return what the scores depend on, by name."""
    here, rows = describe_machine(), [row for each in evaluations for row in each.rows]
    sizes = dict.fromkeys("{}x{}".format(*each.size) for each in evaluations if each.size)
    package = f"instant-avatar-stream {version('instant-avatar-stream')}"
    conditions = {
        "poses": "; ".join(POSES[poses] for poses in dict.fromkeys(row.poses for row in rows)),
        "background": " and ".join(dict.fromkeys(row.background for row in rows)),
        "resolution": f"{', '.join(sizes)} px",
    }
    for each in evaluations:
        scored = max(len(row.scores) for row in each.rows)
        conditions[f"frames of {each.name}"] = f"{scored} of {each.capture}"
        conditions[f"training of {each.name}"] = _describe_training(each)
    return conditions | {
        "PSNR, SSIM": f"{package}: values in [0, 1]; SSIM on RGB, Gaussian of 11 pixels, σ 1.5",
        "LPIPS": lpips.describe(),
        "machine": "{processor}, {cores} cores, {memory_mb} MB".format(**here),
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    }


def evaluation_page(evaluations: Sequence[AvatarEvaluation], conditions: dict[str, str]) -> str:
    """Return the self-contained page."""
    return render_template(
        "evaluation.html",
        title=f"Evaluation of {', '.join(each.name for each in evaluations)}",
        conditions=conditions,
        table=table_cells(evaluations),
        comparison=compare_avatars(evaluations),
        shown={each.name: choose_shown(each.shown) for each in evaluations if each.shown},
        largest_error=LARGEST_SHOWN_ERROR,
    )


def _describe_training(evaluation: AvatarEvaluation) -> str:
    if evaluation.report is None:
        return "not known here"
    training, machine = evaluation.report["training"], evaluation.report["machine"]
    return (
        f"{training['wall_seconds']:.1f} s wall clock, {training['cpu_seconds']:.1f} core-seconds, "
        f"{training['steps']} steps, device {machine['device']}, threads: {machine['threads']}"
    )

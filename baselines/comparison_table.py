"""Results of a comparison as Markdown: scores at the end, and what time is missing."""

import math
from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

COLUMNS = (
    ("", "psnr", "{}, PSNR given", 2), ("_fitted", "psnr", "fitted", 2),
    ("_fitted", "psnr_mask", "in the mask", 2), ("_fitted", "ssim", "SSIM", 4),
)  # fmt: skip
"""Scores of each kind of frames: the poses', the score's name, the column's title, and digits."""
KINDS = {"novel": "novel poses", "held_out": "held-out frames"}
"""Kinds of frames."""
MIN_SLOPE_DB = 0.1
"""Gain for each doubling of the time below which nothing is extrapolated, dB."""


def comparison_table(results: Sequence[dict[str, Any]]) -> str:
    """The table of one capture at the end of training."""
    results = [with_better_poses(each) for each in results]
    head = ["", "core-s", "steps", "core-ms a step"]
    head += [title.format(told) for told in KINDS.values() for _, _, title, _ in COLUMNS]
    rows = [
        [
            each["method"], f"{each['core_seconds']:.0f}", f"{each['steps']:,}", step_cost(each),
            *(
                number(each[kind + poses][key], digits)
                for kind in KINDS
                for poses, key, _, digits in COLUMNS
            ),
        ]
        for each in results
    ]  # fmt: skip
    return "\n".join([*markdown(head, rows), ""])


def with_better_poses(result: Mapping[str, Any]) -> dict[str, Any]:
    """A result whose scores in fitted poses are those in the poses given where these are higher.

    Poses are fitted at a small size, and an exact one can end half a pixel off.
    """
    found = dict(result)
    for kind in KINDS:
        pairs = list(zip(result[kind]["frames"], result[f"{kind}_fitted"]["frames"], strict=True))
        if pairs:
            better = [max(pair, key=lambda score: score["psnr"]) for pair in pairs]
            means = {key: fmean(score[key] for score in better) for _, key, _, _ in COLUMNS}
            found[f"{kind}_fitted"] = {**means, "frames": better}
    return found


def time_to_reach(curve: Sequence[dict[str, Any]], kind: str, wanted: float) -> str:
    """Core time in which a curve reaches a PSNR; beyond its end on its last doublings of time."""
    points = [(point["core_seconds"], point[kind]) for point in curve]
    reached = next((time for time, value in points if value >= wanted), None)
    if reached is not None:
        return duration(reached)
    if len(points) < 2:
        return "not reached"
    (before, low), (end, high) = points[-2:]
    slope = (high - low) / max(math.log2(end / before), 1e-6)
    if slope < MIN_SLOPE_DB:
        return "not reached, and the curve is flat"
    doublings = (wanted - high) / slope
    if doublings > 20.0:
        return "not reached"
    return f"{duration(end * 2.0**doublings)} (extrapolated)"


def step_cost(result: Mapping[str, Any]) -> str:
    """CPU time of a step, core-ms."""
    return f"{1000.0 * result['core_seconds'] / max(result['steps'], 1):,.0f}"


def duration(seconds: float) -> str:
    """Core time for people."""
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:,.0f} min" if seconds < 6000.0 else f"{seconds / 3600.0:,.0f} h"


def number(value: float | None, digits: int) -> str:
    """A score, or a dash."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A table whose columns but the first are numbers."""
    rule = ["---", *["--:"] * (len(head) - 1)]
    return ["| " + " | ".join(cells) + " |" for cells in (head, rule, *rows)]

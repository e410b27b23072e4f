"""Learning curve: scores of held-out frames over training time, and its SVG."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, kw_only=True)
class CurvePoint:
    """One evaluation of held-out frames during training.

    Its scores are estimates from a sample of each frame's pixels, the same ones every time.

    Attributes:
        wall_seconds: Training time up to here, wall clock.
        cpu_seconds: Training time up to here, CPU.
        frames_seen: Frames trained on up to here.
        psnr: Mean PSNR of the whole images of the frames scored here, dB.
        psnr_mask: Mean PSNR inside their masks, dB.
        verdict: Verdict on the scores (`avatar.evaluation.sharpness`).
        frames: Frame number in the video and PSNR of the whole image of each frame scored here.
            Evaluations may score different frames, so only a frame's own scores show a drop.
        video: Number of the video that the frames are from, 1 for the first.
        pixels: Pixels sampled of each frame, at most; None if all were scored.
    """

    wall_seconds: float
    cpu_seconds: float
    frames_seen: int
    psnr: float | None
    psnr_mask: float | None
    verdict: str | None = None
    frames: tuple[tuple[int, float], ...] = ()
    video: int = 1
    pixels: int | None = None

    @classmethod
    def from_checkpoint(cls, content: dict[str, Any]) -> "CurvePoint":
        """Restore a point from a checkpoint."""
        frames = content.get("frames", [])
        return cls(**{**content, "frames": tuple((frame, psnr) for frame, psnr in frames)})


def largest_drops(curve: Sequence[CurvePoint]) -> dict[tuple[int, int], float]:
    """Return each frame's largest drop below its own earlier best, dB; 0 if it never dropped.

    Keys are video and frame number, of the frames that were scored more than once.
    """
    best: dict[tuple[int, int], float] = {}
    drops: dict[tuple[int, int], float] = {}
    for point in curve:
        for number, value in point.frames:
            frame = point.video, number
            if frame in best:
                drops[frame] = max(drops.get(frame, 0.0), best[frame] - value)
            best[frame] = max(best.get(frame, value), value)
    return drops


def largest_drop(curve: Sequence[CurvePoint]) -> float | None:
    """Return the largest of `largest_drops`, dB; None if no frame was scored twice."""
    return max(largest_drops(curve).values(), default=None)


def psnr_at(curve: Sequence[CurvePoint], seconds: float, *, clock: str, score: str) -> float | None:
    """Interpolate a score at a training time, dB; None before the first and after the last point.

    Args:
        curve: The curve; of several videos the last one counts.
        seconds: Training time.
        clock: "wall_seconds" or "cpu_seconds".
        score: "psnr" or "psnr_mask".
    """
    last = max((point.video for point in curve), default=1)
    scored = [
        (getattr(point, clock), value)
        for point in curve
        if point.video == last and (value := getattr(point, score)) is not None
    ]
    if not scored or not scored[0][0] <= seconds <= scored[-1][0]:
        return None
    times, values = zip(*scored, strict=True)
    return float(np.interp(seconds, times, values))


SVG_WIDTH, SVG_HEIGHT = 720, 320
"""Size of the plot with its margins, in SVG units."""
LEFT, RIGHT, TOP, BOTTOM = 46, 16, 26, 48
"""Margins of the plot, for its labels, in SVG units."""

AxisScale = Callable[[float], float]
ScoredPoints = list[tuple[CurvePoint, float]]


def curve_svg(curve: Sequence[CurvePoint]) -> str:
    """Plot held-out PSNR over training time: whole image, and inside the mask.

    Each video has its own line, because its held-out frames cannot be compared with another's.
    Return an empty string if nothing was scored.
    """
    whole = [(p, p.psnr) for p in curve if p.psnr is not None]
    masked = [(p, p.psnr_mask) for p in curve if p.psnr_mask is not None]
    if not whole:
        return ""
    values = [value for _, value in whole + masked]
    low, high = 5.0 * (min(values) // 5.0), 5.0 * (max(values) // 5.0 + 1.0)
    end = max(point.wall_seconds for point, _ in whole)

    def x(seconds: float) -> float:
        return LEFT + (SVG_WIDTH - LEFT - RIGHT) * seconds / max(end, 1e-6)

    def y(decibels: float) -> float:
        return TOP + (SVG_HEIGHT - TOP - BOTTOM) * (high - decibels) / (high - low)

    parts = [
        f'<svg class="curve" viewBox="0 0 {SVG_WIDTH} {SVG_HEIGHT}" role="img" '
        'aria-label="PSNR of held-out frames over seconds of training">',
        *_axes(x, y, low, high, end),
        *_video_labels(whole, x),
        *_polylines(masked, x, y, "masked", "inside the mask"),
        *_polylines(whole, x, y, "whole", "whole image"),
        "</svg>",
    ]
    return "\n".join(parts)


def _axes(x: AxisScale, y: AxisScale, low: float, high: float, end: float) -> list[str]:
    parts = [
        f'<line class="grid" x1="{LEFT}" x2="{SVG_WIDTH - RIGHT}" y1="{y(decibels):.1f}" '
        f'y2="{y(decibels):.1f}"/>'
        f'<text class="tick" x="{LEFT - 8}" y="{y(decibels) + 4.0:.1f}" text-anchor="end">'
        f"{decibels:g}</text>"
        for decibels in (float(n) for n in range(int(low), int(high) + 1, 5))
    ]
    parts += [
        f'<text class="tick" x="{x(seconds):.1f}" y="{SVG_HEIGHT - 28}" text-anchor="middle">'
        f"{seconds:g}</text>"
        for seconds in _ticks(end)
    ]
    parts.append(f'<text class="unit" x="{LEFT - 8}" y="{TOP - 12}" text-anchor="end">dB</text>')
    parts.append(
        f'<text class="unit" x="{SVG_WIDTH - RIGHT}" y="{SVG_HEIGHT - 8}" text-anchor="end">'
        "seconds of training</text>"
    )
    return parts


def _ticks(end: float) -> list[float]:
    step = next((s for s in (0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 30.0, 60.0) if end / s <= 8.0), 300.0)
    return [step * i for i in range(int(end / step) + 1)]


def _video_labels(scored: ScoredPoints, x: AxisScale) -> list[str]:
    """Where each video's line begins, if there are several."""
    first = {point.video: point.wall_seconds for point, _ in reversed(scored)}
    return [
        f'<text class="tick" x="{x(seconds):.1f}" y="{TOP - 12}">video {video}</text>'
        for video, seconds in sorted(first.items())
        if len(first) > 1
    ]


def _polylines(
    scored: ScoredPoints, x: AxisScale, y: AxisScale, kind: str, label: str
) -> list[str]:
    parts = []
    for video in sorted({point.video for point, _ in scored}):
        points = [(p, value) for p, value in scored if p.video == video]
        path = " ".join(f"{x(p.wall_seconds):.1f},{y(value):.1f}" for p, value in points)
        parts.append(f'<polyline class="{kind}" points="{path}"/>')
        parts += [
            f'<circle class="{kind}" cx="{x(p.wall_seconds):.1f}" cy="{y(value):.1f}" r="4">'
            f"<title>{p.wall_seconds:.1f} s: {value:.2f} dB {label}, mean over "
            f"{len(p.frames)} held-out frames</title></circle>"
            for p, value in points
        ]
    return parts

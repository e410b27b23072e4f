"""Figures as SVG: the learning curve, and the body from four sides by how well it was seen."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.spatial import KDTree

from avatar.evaluation.coverage import MIN_WELL_SEEN_COSINE, Coverage
from avatar.evaluation.skin_patches import pose_patches
from avatar.rig import canonical_rotations
from preprocess.body.body_pose import BodyPose
from preprocess.body.body_surface import visible_points
from preprocess.body.parametric_body import ShapedBody


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
        verdict: Verdict on the scores (`avatar.evaluation.image_metrics`).
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


VIEW_AXES = {"front": (0, 1.0), "left": (2, -1.0), "back": (0, -1.0), "right": (2, 1.0)}
"""Axis of the body, and its sign, that points right in each view."""
DOT_SPACING_CM = 2.7
"""Distance of neighboring dots of the hexagonal grid, centimeters."""
PATCHES_PER_DOT = 3
"""Visible skin patches whose median decides the level of a dot."""
MAX_PATCH_DISTANCE_CM = 3.2
"""Distance to the nearest visible patch beyond which a dot lies off the body, centimeters."""
GAP_CM = 14.0
"""Gap between two views, centimeters."""
LABEL_CM = 12.0
"""Height of the line of labels, centimeters."""
LEVELS = ("never", "slant", "well")
"""CSS classes of a dot: unseen, seen at a grazing angle, seen frontally."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _MapView:
    """The dots of one view.

    Attributes:
        positions_cm: Position on the map, y down.
        patches: Indices of the skin patches of each dot.
    """

    positions_cm: Float[np.ndarray, "dots 2"]
    patches: Int[np.ndarray, "dots blended"]


@final
class CoverageMap:
    """Coverage of one person in the A-pose from four sides, as dots."""

    def __init__(self, shaped: ShapedBody, coverage: Coverage) -> None:
        """Assign skin patches to dots; `svg` draws their state at any time."""
        pose = replace(BodyPose.rest(), joint_rotations=canonical_rotations())
        self._coverage = coverage
        transforms = shaped.with_pose(pose).world_from_rest()
        points, normals = pose_patches(coverage.patches, transforms)
        self._views: dict[str, _MapView] = {}
        self._middles: dict[str, float] = {}
        left = 0.0
        for name, (axis, sign) in VIEW_AXES.items():
            view = _map_view(points, normals, axis, sign)
            low, high = view.positions_cm[:, 0].min(), view.positions_cm[:, 0].max()
            view.positions_cm[:, 0] += left - low
            self._views[name] = view
            self._middles[name] = left + (high - low) / 2.0
            left += high - low + GAP_CM
        self._size = left - GAP_CM, max(v.positions_cm[:, 1].max() for v in self._views.values())

    def svg(self) -> str:
        """Draw the coverage in its current state; the CSS classes in `LEVELS` give the colors."""
        level = np.digitize(self._coverage.cosines, [1e-6, MIN_WELL_SEEN_COSINE])
        width, height = self._size
        margin = 1.5 * DOT_SPACING_CM
        parts = [
            f'<svg class="body-map" viewBox="{-margin:.1f} {-margin:.1f} '
            f'{width + 2 * margin:.1f} {height + 2 * margin + LABEL_CM:.1f}" role="img" '
            'aria-label="Body coverage from four sides">'
        ]
        for name, view in self._views.items():
            dots = _dot_levels(view, level)
            for k, kind in enumerate(LEVELS):
                path = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in view.positions_cm[dots == k])
                parts.append(f'<path class="{kind}" d="{path}"/>' if path else "")
            label = f'x="{self._middles[name]:.1f}" y="{height + margin + LABEL_CM - 4.0:.1f}"'
            parts.append(f'<text {label} text-anchor="middle">{name}</text>')
        return "".join([*parts, "</svg>"])


def _map_view(
    points: Float32[np.ndarray, "patches 3"],
    normals: Float32[np.ndarray, "patches 3"],
    axis: int,
    sign: float,
) -> _MapView:
    right, up = np.zeros(3), np.array([0.0, 1.0, 0.0])
    right[axis] = sign
    to_eye = np.cross(right, up)
    plane, facing = points @ np.column_stack([right, up]), normals @ to_eye
    free = visible_points(plane, -(points @ to_eye), facing, cell_m=0.03, tolerance_m=0.03)
    shown = np.flatnonzero(free & (facing > 0.0))
    places = np.column_stack([plane[shown, 0], points[:, 1].max() - plane[shown, 1]]) * 100.0
    dots = _hexagonal_grid(places)
    distance, nearest = map(np.asarray, KDTree(places).query(dots, k=PATCHES_PER_DOT))
    on_the_body = distance[:, 0] < MAX_PATCH_DISTANCE_CM
    return _MapView(positions_cm=dots[on_the_body], patches=shown[nearest[on_the_body]])


def _hexagonal_grid(places: Float[np.ndarray, "visible 2"]) -> Float[np.ndarray, "grid 2"]:
    """Return a hexagonal grid that covers the positions."""
    low, high = places.min(axis=0) - DOT_SPACING_CM, places.max(axis=0) + DOT_SPACING_CM
    rows = np.arange(low[1], high[1], DOT_SPACING_CM * 0.866)
    columns = np.arange(low[0], high[0], DOT_SPACING_CM)
    x, y = np.meshgrid(columns, rows)
    x[1::2] += 0.5 * DOT_SPACING_CM
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _dot_levels(view: _MapView, level: Int[np.ndarray, "patches"]) -> Int[np.ndarray, "dots"]:
    """Return the level of each dot: the median of its patches."""
    return np.median(level[view.patches], axis=1).astype(np.int64)

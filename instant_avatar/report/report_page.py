"""report.html: the values of a report, figures and images as one self-contained page."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, final

import numpy as np
from jaxtyping import Float, Int
from markupsafe import Markup
from scipy.spatial import KDTree

from avatar.evaluation.coverage import MIN_WELL_SEEN_COSINE, Coverage, pose_patches
from avatar.rig import canonical_rotations
from instant_avatar.report.page_rendering import render_template
from instant_avatar.report.report_schema import Report
from preprocess.body.body_pose import BodyPose
from preprocess.body.body_surface import visible_points
from preprocess.body.parametric_body import ShapedBody

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


VIEW_AXES = {"front": (0, 1.0), "left": (2, -1.0), "back": (0, -1.0), "right": (2, 1.0)}
"""Axis of the body, and its sign, that points right in each view."""
DOT_SPACING_CM = 2.7
"""Distance of neighboring dots, centimeters."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _MapView:
    """One view: dots on a hexagonal grid, y down, and the visible skin patch nearest to each."""

    positions_cm: Float[np.ndarray, "dots 2"]
    patches: Int[np.ndarray, "dots"]


@final
class CoverageMap:
    """Coverage of one person in the A-pose from four sides, as dots."""

    def __init__(self, shaped: ShapedBody, coverage: Coverage) -> None:
        """Assign skin patches to dots; `svg` draws their state at any time."""
        pose = replace(BodyPose.rest(), joint_rotations=canonical_rotations())
        points, normals = pose_patches(coverage.patches, shaped.with_pose(pose).world_from_rest())
        self._coverage, self._views, left = coverage, dict[str, _MapView](), 0.0
        for name, (axis, sign) in VIEW_AXES.items():
            right = np.zeros(3)
            right[axis] = sign
            to_eye = np.cross(right, [0.0, 1.0, 0.0])
            plane, facing = np.column_stack([points @ right, points[:, 1]]), normals @ to_eye
            free = visible_points(plane, -(points @ to_eye), facing)
            shown = np.flatnonzero(free & (facing > 0.0))
            top_left = np.array([plane[shown, 0].min(), points[:, 1].max()])
            places = 100.0 * (plane[shown] - top_left) * [1.0, -1.0]
            dots = _hexagonal_grid(places.max(axis=0))
            distance_cm, nearest = map(np.asarray, KDTree(places).query(dots))
            on_body = distance_cm < 3.2
            self._views[name] = _MapView(
                positions_cm=(dots[on_body] + [left, 0.0]).round(1), patches=shown[nearest[on_body]]
            )
            left += float(places[:, 0].max()) + 14.0  # and a gap

    def svg(self) -> Markup:
        """Draw the coverage in its current state; the CSS classes of the dots give the colors."""
        level = np.digitize(self._coverage.cosines, [1e-6, MIN_WELL_SEEN_COSINE])
        everything = np.concatenate([view.positions_cm for view in self._views.values()])
        width, height = everything.max(axis=0).tolist()
        views = [
            (
                name,
                round(float(view.positions_cm[:, 0].min() + view.positions_cm[:, 0].max()) / 2, 1),
                {
                    kind: view.positions_cm[level[view.patches] == k].tolist()
                    for k, kind in enumerate(("never", "slant", "well"))
                },
            )
            for name, view in self._views.items()
        ]
        return render_template("body_map.svg", views=views, width=width, height=height, margin=4.0)


def _hexagonal_grid(size_cm: Float[np.ndarray, "2"]) -> Float[np.ndarray, "grid 2"]:
    """Return the points of a hexagonal grid that covers a rectangle from its top left."""
    x, y = np.meshgrid(
        np.arange(-DOT_SPACING_CM, size_cm[0] + DOT_SPACING_CM, DOT_SPACING_CM),
        # rows of equilateral triangles: sqrt(3) / 2 apart, every second one shifted by a half
        np.arange(-DOT_SPACING_CM, size_cm[1] + DOT_SPACING_CM, 0.866 * DOT_SPACING_CM),
    )
    x[1::2] += 0.5 * DOT_SPACING_CM
    return np.stack([x.ravel(), y.ravel()], axis=1)

"""Coverage map: an SVG of the body from four sides, by how well each place was seen."""

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.spatial import KDTree

from avatar.evaluation.coverage import MIN_WELL_SEEN_COSINE, Coverage
from avatar.evaluation.skin_patches import pose_patches
from avatar.rig import canonical_rotations
from preprocess.body.body_pose import BodyPose
from preprocess.body.body_surface import visible_points
from preprocess.body.parametric_body import ShapedBody

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
        pose = BodyPose(
            root_rotation=np.zeros(3),
            root_translation=np.zeros(3),
            joint_rotations=canonical_rotations(),
        )
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

"""The floor among the points that cameras see, and which way is up."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from preprocess.sfm.sparse_model import SparseModel

MAX_TILT_DEG = 20.0
"""Largest angle between the floor's normal and the first guess of up, degrees."""

PLANE_TOLERANCE = 0.01
"""Distance within which points belong to a plane; a fraction of their median camera distance."""

MIN_POINTS = 40
"""Fewest points that a floor is fitted to."""

MIN_INLIER_FRACTION = 0.05
"""Fraction of the points below the cameras that must lie on the floor."""

MAX_FRACTION_BELOW = 0.05
"""Largest fraction of the points that may lie below the floor."""

RANSAC_ITERATIONS = 2000
"""Number of planes through three points that are tried."""

MIN_VIEWS = 3
"""Fewest cameras that must see a point."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FloorPlane:
    """A plane: normal · x + offset = 0, the normal pointing up to the cameras.

    Attributes:
        normal: Unit vector.
        offset: In the world's own unit.
        points: How many points lie on it; 0 if it was not seen, and only up is known.
    """

    normal: Float[np.ndarray, "3"]
    offset: float
    points: int

    def heights_above(self, places: Float[np.ndarray, "places 3"]) -> Float[np.ndarray, "places"]:
        """How far above it places are."""
        return places @ self.normal + self.offset


def mean_camera_up(model: SparseModel) -> Float[np.ndarray, "3"]:
    """Up as the cameras hold their pictures: minus the mean of their y axes."""
    up = -model.camera_from_world[:, 1, :3].mean(axis=0)
    return up / np.linalg.norm(up)


def fit_floor_plane(
    model: SparseModel, up: Float[np.ndarray, "3"], seed: int = 0
) -> FloorPlane | None:
    """The largest plane below the cameras that is nearly level and has next to nothing below it.

    RANSAC (Fischler & Bolles 1981) over triples of points, then least squares over what is near.

    Args:
        model: Cameras and points.
        up: A first guess.
        seed: Of the draws.
    """
    views = np.bincount(model.observation_point, minlength=len(model.points))
    points = model.points[views >= MIN_VIEWS]
    centers = model.camera_centers()
    distance = np.linalg.norm(
        model.points[model.observation_point] - centers[model.observation_camera], axis=1
    )
    if not len(points):
        return None
    near = PLANE_TOLERANCE * float(np.median(distance))
    lowest = float((centers @ up).min())
    points = points[points @ up < lowest]
    if len(points) < MIN_POINTS:
        return None
    rng = np.random.default_rng(seed)
    best, most = None, max(MIN_POINTS, MIN_INLIER_FRACTION * len(points))
    for _ in range(RANSAC_ITERATIONS):
        plane = _plane_through(points[rng.choice(len(points), 3, replace=False)], up)
        if plane is None:
            continue
        heights = points @ plane[0] + plane[1]
        inside = np.abs(heights) < near
        if inside.sum() > most and (heights < -3.0 * near).mean() < MAX_FRACTION_BELOW:
            best, most = inside, float(inside.sum())
    return None if best is None else _refine_plane(points, best, up, near)


def _plane_through(
    three: Float[np.ndarray, "3 3"], up: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3"], float] | None:
    """The plane through three points, if it is nearly level."""
    normal = np.cross(three[1] - three[0], three[2] - three[0])
    length = float(np.linalg.norm(normal))
    if length < 1e-12:
        return None
    normal = normal / length * (1.0 if normal @ up > 0.0 else -1.0)
    if normal @ up < np.cos(np.radians(MAX_TILT_DEG)):
        return None
    return normal, -float(normal @ three[0])


def _refine_plane(
    points: Float[np.ndarray, "points 3"],
    inside: Bool[np.ndarray, "points"],
    up: Float[np.ndarray, "3"],
    near: float,
) -> FloorPlane:
    """Least squares over the points of the plane, three times."""
    normal, offset = up, 0.0
    for _ in range(3):
        middle = points[inside].mean(axis=0)
        normal = np.linalg.svd(points[inside] - middle, full_matrices=False)[2][2]
        normal = normal if normal @ up > 0.0 else -normal
        offset = -float(normal @ middle)
        inside = np.abs(points @ normal + offset) < near
    return FloorPlane(normal=normal, offset=offset, points=int(inside.sum()))

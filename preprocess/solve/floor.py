"""The floor among the points that cameras see, and which way is up."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from preprocess.solve.model import Model

MOST_TILT_DEG = 20.0
"""Between the floor's normal and the first guess of up."""
NEAR = 0.01
"""Points this near belong to a plane; in median distances of points from cameras."""
LEAST_POINTS = 40
LEAST_SHARE = 0.05
"""Of the points below the cameras that the floor must hold."""
MOST_BELOW = 0.05
"""Of the points, how many may lie below a floor."""
TRIES = 2000
LEAST_VIEWS = 3


@dataclass(frozen=True, eq=False, kw_only=True)
class Floor:
    """A plane: normal · x + offset = 0, the normal pointing up to the cameras.

    Attributes:
        normal: Unit vector.
        offset: In the world's own unit.
        points: How many points lie on it; 0 if it was not seen, and only up is known.
    """

    normal: Float[np.ndarray, "3"]
    offset: float
    points: int

    def heights(self, places: Float[np.ndarray, "places 3"]) -> Float[np.ndarray, "places"]:
        """How far above it places are."""
        return places @ self.normal + self.offset


def up_of_cameras(model: Model) -> Float[np.ndarray, "3"]:
    """Up as the cameras hold their pictures: minus the mean of their y axes."""
    up = -model.camera_from_world[:, 1, :3].mean(axis=0)
    return up / np.linalg.norm(up)


def find_floor(model: Model, up: Float[np.ndarray, "3"], seed: int = 0) -> Floor | None:
    """The largest plane below the cameras that is nearly level and has next to nothing below it.

    RANSAC (Fischler & Bolles 1981) over triples of points, then least squares over what is near.

    Args:
        model: Cameras and points.
        up: A first guess.
        seed: Of the draws.
    """
    views = np.bincount(model.seen_point, minlength=len(model.points))
    points = model.points[views >= LEAST_VIEWS]
    centers = model.centers()
    distance = np.linalg.norm(model.points[model.seen_point] - centers[model.seen_by], axis=1)
    if not len(points):
        return None
    near = NEAR * float(np.median(distance))
    lowest = float((centers @ up).min())
    points = points[points @ up < lowest]
    if len(points) < LEAST_POINTS:
        return None
    rng = np.random.default_rng(seed)
    best, most = None, max(LEAST_POINTS, LEAST_SHARE * len(points))
    for _ in range(TRIES):
        plane = _through(points[rng.choice(len(points), 3, replace=False)], up)
        if plane is None:
            continue
        heights = points @ plane[0] + plane[1]
        inside = np.abs(heights) < near
        if inside.sum() > most and (heights < -3.0 * near).mean() < MOST_BELOW:
            best, most = inside, float(inside.sum())
    return None if best is None else _refined(points, best, up, near)


def _through(
    three: Float[np.ndarray, "3 3"], up: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3"], float] | None:
    """The plane through three points, if it is nearly level."""
    normal = np.cross(three[1] - three[0], three[2] - three[0])
    length = float(np.linalg.norm(normal))
    if length < 1e-12:
        return None
    normal = normal / length * (1.0 if normal @ up > 0.0 else -1.0)
    if normal @ up < np.cos(np.radians(MOST_TILT_DEG)):
        return None
    return normal, -float(normal @ three[0])


def _refined(
    points: Float[np.ndarray, "points 3"],
    inside: Bool[np.ndarray, "points"],
    up: Float[np.ndarray, "3"],
    near: float,
) -> Floor:
    """Least squares over the points of the plane, three times."""
    normal, offset = up, 0.0
    for _ in range(3):
        middle = points[inside].mean(axis=0)
        normal = np.linalg.svd(points[inside] - middle, full_matrices=False)[2][2]
        normal = normal if normal @ up > 0.0 else -normal
        offset = -float(normal @ middle)
        inside = np.abs(points @ normal + offset) < near
    return Floor(normal=normal, offset=offset, points=int(inside.sum()))

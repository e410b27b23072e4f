"""Colors of Gaussians by least squares: drawn as splat viewers draw them, they show the avatar.

Gaussians overlap, and a viewer blurs them; what a color along the surface's normal misses (folds,
the sides of a nose, fog) the avatar's own pictures from around it hold.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32
from scipy.sparse import csr_array, vstack
from scipy.spatial.transform import Rotation

from capture.camera import Camera

MARGIN = 1.15
"""Width of what they see, in diagonals of the avatar's box."""
ITERATIONS = 8
"""Iterations of least squares."""
OWN_WEIGHT = 0.3
"""Weight of a Gaussian's own color, in pixels that it fills: what no picture shows stays so."""
MAX_SQUARED_DISTANCE = 8.0
"""Squared distance from its center, in variances, at which a Gaussian is cut off."""
MIN_ALPHA = 1.0 / 512.0
"""Least alpha, and least light that is left before a Gaussian, that count."""


def cameras_around(
    positions: Float[np.ndarray, "points 3"], *, views: int, pixel_m: float
) -> list[Camera]:
    """Cameras around points, y up, that show all of them; pixels are squares of `pixel_m`."""
    low, high = positions.min(axis=0), positions.max(axis=0)
    middle, size_m = 0.5 * (low + high), MARGIN * float(np.linalg.norm(high - low))
    side = int(np.ceil(size_m / pixel_m))
    focal, distance_m = side * 1.5, 1.5 * size_m
    found = []
    for number in range(views):
        turn = 2.0 * np.pi * number / views
        tilt = 0.3 if number % 2 else -0.3  # radians, down and up
        # the first camera, before the body, looks along -z with y down
        right_up = Rotation.from_euler("YX", [np.pi + turn, tilt]).as_matrix().T
        axes = np.diag([-1.0, -1.0, 1.0]) @ right_up
        found.append(Camera.at(middle - distance_m * axes[2], axes, focal, (side, side)))
    return found


def fit_colors(
    positions: Float[np.ndarray, "splats 3"],
    axes: Float[np.ndarray, "splats 3 3"],
    opacities: Float[np.ndarray, "splats"],
    colors: Float[np.ndarray, "splats 3"],
    cameras: Sequence[Camera],
    pictures: Sequence[Float32[np.ndarray, "height width 3"]],
) -> Float[np.ndarray, "splats 3"]:
    """Find colors near the given ones, so that Gaussians look like pictures on white.

    Args:
        axes: Columns are the Gaussians' axes times their standard deviations, metres; the last one
            is the surface's normal.
        opacities: At their centers.
    """
    views = [_shares_of_pixels(positions, axes, opacities, camera) for camera in cameras]
    drawn = [view.sum(axis=1) for view in views]
    shares, filled = vstack(views).tocsr(), np.concatenate(drawn)
    wanted = np.concatenate([picture.reshape(-1, 3) for picture in pictures])
    wanted = wanted - (1.0 - filled)[:, None]
    back = shares.T.tocsr()
    weights = back @ np.ones(len(filled)) + OWN_WEIGHT
    found = colors
    for _ in range(ITERATIONS):  # SIRT, with a prior
        step = back @ (wanted - shares @ found) + OWN_WEIGHT * (colors - found)
        found = np.clip(found + step / weights[:, None], 0.0, 1.0)
    return found


def _shares_of_pixels(
    positions: Float[np.ndarray, "splats 3"],
    axes: Float[np.ndarray, "splats 3 3"],
    opacities: Float[np.ndarray, "splats"],
    camera: Camera,
) -> csr_array:
    """How much of each pixel each Gaussian fills, those before it considered (EWA)."""
    turn = camera.camera_from_world[:3, :3]
    points = positions @ turn.T + camera.camera_from_world[:3, 3]
    order = np.argsort(points[:, 2])
    points, depth = points[order], points[order, 2:]
    centers = points[:, :2] / depth * camera.focal_px + camera.center_px
    slopes = np.zeros((len(points), 2, 3))
    slopes[:, [0, 1], [0, 1]] = camera.focal_px / depth
    slopes[:, :, 2] = -points[:, :2] / depth**2 * camera.focal_px
    slopes = slopes @ (turn @ axes[order])
    shape = slopes @ slopes.transpose(0, 2, 1)
    wide = shape + 0.3 * np.eye(2)  # viewers' (Mip-Splatting, Yu et al. 2024)
    thinner = np.sqrt(np.maximum(np.linalg.det(shape), 0.0) / np.linalg.det(wide))
    peaks = (opacities[order] * thinner).astype(np.float32)
    narrow = np.linalg.inv(wide).astype(np.float32)
    reach = np.ceil(np.sqrt(MAX_SQUARED_DISTANCE * wide[:, [0, 1], [0, 1]].max(axis=1))).astype(int)
    normals = axes[order, :, 2] @ turn.T
    lengths = np.linalg.norm(points, axis=1) * np.linalg.norm(normals, axis=1)
    seen = np.einsum("va,va->v", points, normals) <= 0.4 * lengths
    width, height = camera.size_px
    parts = []
    for radius in np.unique(reach):
        some = np.flatnonzero((reach == radius) & seen)
        grid = np.arange(-radius, radius + 1)
        for row in grid:
            window = np.stack([grid, np.full_like(grid, row)], axis=1)
            pixels = np.floor(centers[some]).astype(np.int64)[:, None] + window
            x, y = np.moveaxis((pixels + 0.5 - centers[some, None]).astype(np.float32), -1, 0)
            form = narrow[some, :, :, None]
            power = form[:, 0, 0] * x * x + 2.0 * form[:, 0, 1] * x * y + form[:, 1, 1] * y * y
            alpha = peaks[some, None] * np.exp(-0.5 * power)
            inside = (power < MAX_SQUARED_DISTANCE) & (alpha > MIN_ALPHA)
            place = pixels[..., 1] * width + pixels[..., 0]
            parts.append((place[inside], some[np.nonzero(inside)[0]], alpha[inside]))
    place, splat, alpha = (np.concatenate(each) for each in zip(*parts, strict=True))
    # pixel after pixel, the nearest Gaussian first
    sort = np.argsort(place * len(points) + splat)
    place, passed = place[sort], np.log1p(-alpha[sort].astype(np.float64))
    before = np.cumsum(passed) - passed
    light = np.exp(before - before[np.searchsorted(place, place)])
    kept = light > MIN_ALPHA
    entries = (light * alpha[sort])[kept], (place[kept], order[splat[sort][kept]])
    return csr_array(entries, shape=(width * height, len(points)))

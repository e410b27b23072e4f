"""ResectionResult the legs: where photographs of few poses leave matter that is no part of anybody."""

import numpy as np
from jaxtyping import Bool, Float, Int64
from scipy.spatial import KDTree

from avatar.rig import Rig

OFF_SKIN_M = 0.02
"""Nearer to the skin than this clothes lie, and nothing is said about them."""
MAX_LEG_DISTANCE_M = 0.3
"""A leg that is farther away than this has no say."""
MAX_DIRECTION_COSINE = 0.5
"""Cosine of 60°: a place is between the legs if it sees them farther apart than this."""
LEFT_LEG_PARTS, RIGHT_LEG_PARTS = (1, 3, 5), (2, 4, 6)
"""Their body parts (`avatar.rig.PARTS`)."""


def inner_leg_cells(rig: Rig, cells: Int64[np.ndarray, "cells"]) -> Bool[np.ndarray, "cells"]:
    """Which occupancy cells lie off the skin between the legs.

    Where thighs touch in every photograph, canonical space has them apart, and skinning folds what
    is between into them. No ray tells whether anything is there; when the legs part, it is a web.

    Args:
        rig: Whose body.
        cells: Flat numbers of cells of `rig.distance`.
    """
    found = np.zeros(len(cells), dtype=bool)
    away = (rig.skin_distance.reshape(-1)[cells] > OFF_SKIN_M) & ~rig.inside_skin.reshape(-1)[cells]
    off = np.flatnonzero(away)
    place = np.stack(np.unravel_index(cells[off], rig.skin_distance.shape), axis=1) + 0.5
    points = rig.box_low + place * (rig.box_high - rig.box_low) / rig.skin_distance.shape
    to_left, left_m = _nearest_leg_seed(rig, LEFT_LEG_PARTS, points)
    to_right, right_m = _nearest_leg_seed(rig, RIGHT_LEG_PARTS, points)
    apart = (to_left * to_right).sum(axis=1) < MAX_DIRECTION_COSINE
    found[off] = apart & (np.maximum(left_m, right_m) < MAX_LEG_DISTANCE_M)
    return found


def _nearest_leg_seed(
    rig: Rig, parts: tuple[int, ...], points: Float[np.ndarray, "points 3"]
) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points"]]:
    """Direction to the nearest seed of some body parts, and how far away it is."""
    seeds = rig.seeds[np.isin(rig.seed_parts, parts)]
    if not len(seeds):
        return np.zeros_like(points), np.full(len(points), np.inf)
    distance, index = KDTree(seeds).query(points)
    return (seeds[index] - points) / np.maximum(distance, 1e-9)[:, None], distance

"""Repair of short stretches in which a tracker took the person's left for the right.

Only frames close in time are compared, and only a stretch that both its neighbors contradict is
changed: where nothing is wrong, nothing happens.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from preprocess.tracking.keypoint_track import KeypointTrack

LEFT_POINTS = (1, 2, 3, *range(7, 33, 2))
"""The person's left key points."""
RIGHT_POINTS = (4, 5, 6, *range(8, 33, 2))
"""The right ones, in the same order."""
COMPARED_POINTS = (11, 13, 23, 25, 27)
"""Left shoulder, elbow, hip, knee and ankle."""
MAX_COSINE = -0.4
"""Cosine between the directions from right to left of two frames below which one is swapped."""
MAX_STRETCH_FRAMES = 15
"""Longest stretch that is repaired, frames."""
MAX_GAP_FRAMES = 3
"""Frames between two rows beyond which they are not compared."""


def repair_swaps(track: KeypointTrack) -> tuple[KeypointTrack, Bool[np.ndarray, "rows"]]:
    """Exchange left and right where a short stretch contradicts the frames on both its sides.

    Returns:
        The track, and the rows that were changed.
    """
    swapped = find_swaps(track)
    mirrored = np.arange(33)
    mirrored[list(LEFT_POINTS)], mirrored[list(RIGHT_POINTS)] = RIGHT_POINTS, LEFT_POINTS
    order = np.where(swapped[:, None], mirrored, np.arange(33))
    rows = np.arange(len(track))[:, None]
    repaired = replace(
        track,
        image_px=track.image_px[rows, order],
        world_m=track.world_m[rows, order],
        visibility=track.visibility[rows, order],
    )
    return repaired, swapped


def find_swaps(track: KeypointTrack) -> Bool[np.ndarray, "rows"]:
    """Rows in which left and right are exchanged, by their neighbors."""
    across = track.world_m[:, list(COMPARED_POINTS)]
    across = across - track.world_m[:, [point + 1 for point in COMPARED_POINTS]]
    flat = across.reshape(len(track), -1)
    near = np.diff(track.frames) <= MAX_GAP_FRAMES
    turns = np.flatnonzero(near & (_cosines(flat) < MAX_COSINE)) + 1
    found = np.zeros(len(track), dtype=bool)
    bounds = [0, *turns.tolist(), len(track)]
    for index in range(1, len(bounds) - 2):
        start, stop = bounds[index], bounds[index + 1]
        length = stop - start
        beside = min(start - bounds[index - 1], bounds[index + 2] - stop)
        if length <= min(MAX_STRETCH_FRAMES, beside) and not found[start - 1]:
            found[start:stop] = True
    return found


def _cosines(rows: Float[np.ndarray, "rows n"]) -> Float[np.ndarray, "gaps"]:
    """Cosine between each row and the next."""
    size = np.maximum(np.linalg.norm(rows, axis=1), 1e-9)
    return (rows[1:] * rows[:-1]).sum(axis=1) / (size[1:] * size[:-1])

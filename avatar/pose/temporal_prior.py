"""Temporal prior of a pose correction: a tracker's error changes slowly from frame to frame.

Where a frame's own rays leave its pose undetermined, the corrections of neighboring frames are a
better guess than none. Whether that holds is measured on the corrections that the rays alone would
make: if neighbors are uncorrelated, nothing is shared.
"""

from collections.abc import Mapping
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float, Int64

MIN_NEIGHBOR_PAIRS = 12
"""Neighbor pairs below which their correlation cannot be measured."""
MAX_FRAME_GAP = 6
"""Distance in frames beyond which neighbors are ignored."""
MIN_CORRELATION = 0.1
"""Correlation of neighbors' errors up to which they are ignored."""
FULL_CORRELATION = 0.3
"""Correlation of neighbors' errors from which they have their full precision."""
NEIGHBOR_PRECISION = 8.0
"""Precision of all neighbors together, relative to that of the tracker's pose."""


class PosePrior(NamedTuple):
    """Prior of a correction, before the evidence of its frame's rays.

    Attributes:
        mean: Expected correction: radians, and metres in the last row.
        precision: Precision relative to that of a frame without neighbors.
    """

    mean: Float[np.ndarray, "25 3"]
    precision: float


UNINFORMATIVE_PRIOR = PosePrior(np.zeros((25, 3)), 1.0)
"""Prior without neighbors: the tracker's pose, with its own precision."""


@final
class TemporalPosePrior:
    """Estimates of the replay frames' corrections, as neighbors of one another."""

    def __init__(self, capacity: int) -> None:
        """Starts without frames, for a number of slots."""
        self._frames = np.zeros(capacity, dtype=np.int64)
        self._unregularized = np.zeros((capacity, 25, 3))
        self._is_sequential, self._has_estimate = np.zeros((2, capacity), dtype=bool)

    def set_frame(self, slot: int, frame: int | None) -> None:
        """Assigns a frame number to a slot; None if the frame has no neighbors."""
        self._is_sequential[slot], self._has_estimate[slot] = frame is not None, False
        self._frames[slot] = frame or 0

    def record_estimate(self, slot: int, unregularized: Float[np.ndarray, "25 3"]) -> None:
        """Records the correction that a slot's rays alone would make, in prior sigmas."""
        self._unregularized[slot], self._has_estimate[slot] = (
            unregularized,
            self._is_sequential[slot],
        )

    def prior_for(self, slot: int, corrections: Float[np.ndarray, "slots 25 3"]) -> PosePrior:
        """Prior of a slot's correction from the other slots."""
        row, asked = self._is_sequential, self._has_estimate
        if not row[slot]:
            return UNINFORMATIVE_PRIOR
        alike = neighbor_correlation(self._frames[asked], self._unregularized[asked])
        return prior_from_neighbors(
            int(self._frames[slot]), self._frames[row], corrections[row], alike
        )


def neighbor_correlation(
    frames: Int64[np.ndarray, "asked"], estimates: Float[np.ndarray, "asked 25 3"]
) -> float:
    """How alike the errors of neighbouring frames are, in [-1, 1]; 0 if too few tell.

    Args:
        frames: Indices of the frames, in any order.
        unregularized: Correction of each frame by its rays alone, in any unit.
    """
    order = np.argsort(frames, kind="stable")
    apart = np.diff(frames[order])
    near = np.flatnonzero((apart > 0) & (apart <= MAX_FRAME_GAP))
    if len(near) < MIN_NEIGHBOR_PAIRS:
        return 0.0
    one, other = estimates[order[near]], estimates[order[near + 1]]
    power = 0.5 * float((one**2).sum() + (other**2).sum())
    return float((one * other).sum()) / max(power, 1e-12)


def prior_from_neighbors(
    frame: int,
    frames: Int64[np.ndarray, "others"],
    corrections: Float[np.ndarray, "others 25 3"],
    error_correlation: float,
) -> PosePrior:
    """Prior of a correction: the mean of neighboring frames' corrections, weighted by nearness.

    Args:
        frame: Index of the frame.
        frames: Indices of its neighbors; its own is ignored.
        corrections: Corrections of the neighbors.
        error_correlation: Correlation of neighboring frames' errors.
    """
    share = min(
        max((error_correlation - MIN_CORRELATION) / (FULL_CORRELATION - MIN_CORRELATION), 0.0), 1.0
    )
    apart = np.abs(frames - frame)
    near = (apart > 0) & (apart <= MAX_FRAME_GAP)
    if share == 0.0 or not near.any():
        return UNINFORMATIVE_PRIOR
    weights = 1.0 / apart[near]
    mean = np.einsum("s,sja->ja", weights / weights.sum(), corrections[near])
    worth = share * NEIGHBOR_PRECISION
    return PosePrior(worth / (1.0 + worth) * mean, 1.0 + worth)


def interpolate_correction(
    frame: int, corrections: Mapping[int, Float[np.ndarray, "25 3"]]
) -> Float[np.ndarray, "25 3"]:
    """The correction of a frame that was never learnt from, by those of its neighbours.

    Args:
        frame: Its number.
        corrections: Of frames' poses, by their numbers.
    """
    if not corrections:
        return UNINFORMATIVE_PRIOR.mean
    frames, found = np.array(list(corrections)), np.array(list(corrections.values()))
    return prior_from_neighbors(frame, frames, found, neighbor_correlation(frames, found)).mean

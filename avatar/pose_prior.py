"""What the poses around a frame's say of its error: trackers wander rather than flicker.

A tracker's error is much the same from one frame to the next, so where a frame's own rays leave its
pose open, its neighbours' corrections are a better guess than none. Whether they are is found out
from what the rays alone would make of each pose: where errors flicker, nothing is shared.
"""

from collections.abc import Mapping
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float, Int64

FEWEST_PAIRS = 12
"""Fewer neighbours do not tell whether errors hang together."""
FARTHEST_APART = 6
"""Frames; neighbours farther apart say nothing."""
FLICKERING, WANDERING = 0.1, 0.3
"""Correlation of neighbours' errors up to which they say nothing, and from which they say all."""
WORTH = 8.0
"""How much all neighbours together are then believed, in times of the given pose."""


class PosePrior(NamedTuple):
    """What is believed of a correction before its frame's rays are asked.

    Attributes:
        mean: The correction that is expected: radians, and metres in the last row.
        precision: How sure that is, in times of what is believed of a frame without neighbours.
    """

    mean: Float[np.ndarray, "25 3"]
    precision: float


UNKNOWN = PosePrior(np.zeros((25, 3)), 1.0)
"""Nobody tells anything: the given pose is as likely as it ever is."""


@final
class Neighbours:
    """What is known of the frames in replay as neighbours of one another."""

    def __init__(self, capacity: int) -> None:
        """Nothing yet, of so many slots."""
        self._frames = np.zeros(capacity, dtype=np.int64)
        self._alone = np.zeros((capacity, 25, 3))
        self._in_a_row, self._asked = np.zeros((2, capacity), dtype=bool)

    def put(self, slot: int, frame: int | None) -> None:
        """A slot takes in a frame of this number; None if it has no neighbours."""
        self._in_a_row[slot], self._asked[slot] = frame is not None, False
        self._frames[slot] = frame or 0

    def tell(self, slot: int, alone: Float[np.ndarray, "25 3"]) -> None:
        """What a slot's rays alone would correct, in units of its spread."""
        self._alone[slot], self._asked[slot] = alone, self._in_a_row[slot]

    def expected(self, slot: int, corrections: Float[np.ndarray, "slots 25 3"]) -> PosePrior:
        """What the others say of a slot's correction."""
        row, asked = self._in_a_row, self._asked
        if not row[slot]:
            return UNKNOWN
        alike = correlation(self._frames[asked], self._alone[asked])
        return expected(int(self._frames[slot]), self._frames[row], corrections[row], alike)


def correlation(
    frames: Int64[np.ndarray, "asked"], alone: Float[np.ndarray, "asked 25 3"]
) -> float:
    """How alike the errors of neighbouring frames are, in [-1, 1]; 0 if too few tell.

    Args:
        frames: Their numbers, in any order.
        alone: The correction that each one's rays alone ask for, or that was found, in any units.
    """
    order = np.argsort(frames, kind="stable")
    apart = np.diff(frames[order])
    near = np.flatnonzero((apart > 0) & (apart <= FARTHEST_APART))
    if len(near) < FEWEST_PAIRS:
        return 0.0
    one, other = alone[order[near]], alone[order[near + 1]]
    power = 0.5 * float((one**2).sum() + (other**2).sum())
    return float((one * other).sum()) / max(power, 1e-12)


def expected(
    frame: int,
    frames: Int64[np.ndarray, "others"],
    corrections: Float[np.ndarray, "others 25 3"],
    alike: float,
) -> PosePrior:
    """What frames around a frame say of its correction: their mean, the nearest counting most.

    Args:
        frame: Its number.
        frames: The others'; its own tells nothing.
        corrections: Of the others' poses.
        alike: Correlation of neighbouring frames' errors.
    """
    share = min(max((alike - FLICKERING) / (WANDERING - FLICKERING), 0.0), 1.0)
    apart = np.abs(frames - frame)
    near = (apart > 0) & (apart <= FARTHEST_APART)
    if share == 0.0 or not near.any():
        return UNKNOWN
    weights = 1.0 / apart[near]
    mean = np.einsum("s,sja->ja", weights / weights.sum(), corrections[near])
    worth = share * WORTH
    return PosePrior(worth / (1.0 + worth) * mean, 1.0 + worth)


def guessed(
    frame: int, corrections: Mapping[int, Float[np.ndarray, "25 3"]]
) -> Float[np.ndarray, "25 3"]:
    """The correction of a frame that was never learnt from, by those of its neighbours.

    Args:
        frame: Its number.
        corrections: Of frames' poses, by their numbers.
    """
    if not corrections:
        return UNKNOWN.mean
    frames, found = np.array(list(corrections)), np.array(list(corrections.values()))
    return expected(frame, frames, found, correlation(frames, found)).mean

"""Which pose belongs to which frame, where times tell."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from capture.errors import InputError
from capture.source import FrameSource

MAX_TIME_OFFSET_S = 0.05
"""A pose from farther away is no frame's own, however few poses there are."""
MIN_MATCHED_FRACTION = 0.1
"""Share of the frames, or of the poses, that must belong together by their times."""


def associate_by_time(
    times_s: Float[np.ndarray, "poses"], source: FrameSource
) -> Callable[[float], int | None]:
    """From a frame's time to the row nearest to it, or to None where none is near.

    Args:
        times_s: Of the poses, in any order; NaN where unknown.
        source: The frames; what its container claims of their rate bounds how near a row must be.

    Raises:
        InputError: If hardly any frame has a pose at its time.
    """
    row_of = _nearest_row(times_s, _frame_interval_s(source))
    _check_time_matches(times_s, source, row_of)
    return row_of


def _frame_interval_s(source: FrameSource) -> float | None:
    """From one wanted frame to the next, as the container claims."""
    if not source.duration_s or not source.frame_count:
        return None
    return source.duration_s / source.frame_count


def _check_time_matches(
    times_s: Float[np.ndarray, "poses"], source: FrameSource, row_of: Callable[[float], int | None]
) -> None:
    """Raises if hardly any frame has a pose at its time."""
    step, count = _frame_interval_s(source), source.frame_count
    if step is None or count is None:
        return
    start = source.selection.start * step / source.selection.step
    found = {row_of(start + step * number) for number in range(count)} - {None}
    most = min(count, len(times_s))
    if len(found) < max(min(2, most), MIN_MATCHED_FRACTION * most):
        known = times_s[np.isfinite(times_s)]
        said = f"{known.min():.6g} to {known.max():.6g} s" if len(known) else "unknown times"
        raise InputError(
            f"The poses are those of {said}, the frames of {source.path} those of {start:.3g} to "
            f"{start + step * count:.3g} s; `time` was expected in seconds since the video's first "
            "frame. Is it in milliseconds, or by another clock?"
        )


def _nearest_row(
    times_s: Float[np.ndarray, "poses"], frame_step_s: float | None
) -> Callable[[float], int | None]:
    """The row nearest to a time, if it is nearer than half the usual step, and near at all."""
    finite = np.flatnonzero(np.isfinite(times_s))
    rows = finite[np.argsort(times_s[finite], kind="stable")]
    times = times_s[rows]
    steps = np.diff(times)
    reach = 0.5 * float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.02
    reach = min(reach, max(MAX_TIME_OFFSET_S, 0.5 * (frame_step_s or 0.0)))

    def row(time_s: float) -> int | None:
        place = int(np.searchsorted(times, time_s))
        around = range(max(0, place - 1), min(len(times), place + 1))
        nearest = min(around, key=lambda i: abs(times[i] - time_s), default=None)
        if nearest is None or abs(times[nearest] - time_s) > reach + 1e-6:
            return None
        return int(rows[nearest])

    return row

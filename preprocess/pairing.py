"""Which row of a file belongs to which frame, where nothing but the order tells."""

from collections.abc import Callable

from capture.errors import InputError
from capture.source import FrameSource

NUMBERING_HINT = "; or say which frame each belongs to (the keys `frame` or `time`)"


def associate_by_order(rows: int, source: FrameSource, things: str) -> Callable[[int], int]:
    """From a frame's number to its row: one row a frame, of all frames or of the wanted ones.

    The container's claim counts, so that a truncated video still fits its poses; where it does not
    fit, the frames are counted by decoding them.

    Args:
        rows: How many rows the file has.
        source: The frames.
        things: What the rows are, for the message ("poses in poses.npz").

    Raises:
        InputError: If there are more or fewer rows than frames.
    """
    for total in (source.frames_in_file, None):
        count = source.count_frames() if total is None else total
        if rows == count:
            return lambda index: index
        if rows == source.selection.count(count):
            return source.selection.position
    raise InputError(
        f"There are {rows} {things}, but {count} frames in {source.path}. Expected one for every "
        f"frame, in order{NUMBERING_HINT if things.startswith('poses') else ''}.{_mismatch_hint(rows, count)}"
    )


def _mismatch_hint(rows: int, count: int) -> str:
    """What may have happened, and what to do then."""
    if rows > count:
        return " Was the video cut, or written anew with fewer frames a second?"
    step = round(count / rows)
    if step > 1 and rows == -(-count // step):
        return f" If they are those of one frame in {step}: --frames ::{step}."
    return f" If they are those of the first {rows} frames: --frames 0:{rows}."

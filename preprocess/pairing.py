"""Which row of a file belongs to which frame, where nothing but the order tells."""

from collections.abc import Callable

from capture.errors import BadInput
from capture.source import Source


def row_by_order(rows: int, source: Source, things: str) -> Callable[[int], int]:
    """From a frame's number to its row: one row a frame, of all frames or of the wanted ones.

    The container's claim counts, so that a truncated video still fits its poses; where it does not
    fit, the frames are counted by decoding them.

    Args:
        rows: How many rows the file has.
        source: The frames.
        things: What the rows are, for the message ("poses in poses.npz").

    Raises:
        BadInput: If there are more or fewer rows than frames.
    """
    for total in (source.frames_in_file, None):
        count = source.count_frames() if total is None else total
        if rows == count:
            return lambda index: index
        if rows == source.selection.count(count):
            return source.selection.position
    raise BadInput(
        f"There are {rows} {things}, but {count} frames in {source.path}. Expected one for every "
        "frame, in order; or say which frame each belongs to (poses: the keys `frame` or `time`)."
    )

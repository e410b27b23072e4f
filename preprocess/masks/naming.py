"""Which frame each mask of a folder belongs to, where some frames have none: by their names."""

import re
from collections.abc import Sequence

from capture.images import list_images
from capture.source import FrameSource


def associate_by_name(names: Sequence[str], source: FrameSource) -> dict[int, int] | None:
    """The masks' rows by their frames' numbers; None where names do not tell.

    In a folder of pictures a mask belongs to the picture of its name, or of its number. In a video
    numbers count the frames, from 0 if one is 0, from 1 if one is that of the last frame. Numbers
    without a gap are the count of a few chosen frames, and say nothing. Where half of the frames or
    more would have no mask, somebody has chosen, and should say so.

    Args:
        names: Of the masks' files, without their endings.
        source: The frames.
    """
    if 2 * len(names) <= source.frames_in_file:
        return None
    if source.path.is_dir():
        pictures = [file.stem for file in list_images(source.path)]
        return _match_names(names, pictures) or _match_names(_unique_numbers(names), _unique_numbers(pictures))
    numbers, total = _unique_numbers(names), source.frames_in_file
    if numbers is None:
        return None
    first = 0 if min(numbers) == 0 else 1 if max(numbers) == total else None
    if first is None or max(numbers) - first >= total:
        return None
    if min(numbers) == first and max(numbers) - first + 1 == len(numbers):
        return None
    return {number - first: row for row, number in enumerate(numbers)}


def _match_names(
    masks: Sequence[str | int] | None, pictures: Sequence[str | int] | None
) -> dict[int, int] | None:
    """Rows by frames, if every mask has its own picture."""
    if masks is None or pictures is None:
        return None
    frame_of = {picture: frame for frame, picture in enumerate(pictures)}
    rows = {frame_of[mask]: row for row, mask in enumerate(masks) if mask in frame_of}
    return rows if len(rows) == len(masks) else None


def _unique_numbers(names: Sequence[str]) -> list[int] | None:
    """The last number in each name; None unless all have one of their own."""
    found = [re.findall(r"\d+", name) for name in names]
    if not found or not all(found):
        return None
    numbers = [int(digits[-1]) for digits in found]
    return numbers if len(set(numbers)) == len(numbers) else None

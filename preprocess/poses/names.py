"""Frame numbers out of the names of files that hold a frame each."""

import re
from collections.abc import Iterable


def frame_numbers_from_names(names: Iterable[str]) -> list[int]:
    """The last number in each name; the place in order where a name has none, or two have one."""
    listed = list(names)
    found = [re.findall(r"\d+", name.rsplit(".", 1)[0].rsplit("/", 1)[-1]) for name in listed]
    if not all(found) or len({int(numbers[-1]) for numbers in found}) < len(listed):
        return list(range(len(listed)))
    return [int(numbers[-1]) for numbers in found]

"""Parts that other packages register as entry points: segmenters and trackers."""

from importlib.metadata import entry_points
from typing import Any

from capture.input_error import InputError


def make_plugin(kind: str, name: str, *arguments: object, own: str, option: str) -> Any:
    """Make a part that an installed package registers.

    Its entry point NAME = "module:make" lies in the group `instant_avatar.KINDs`.

    Args:
        kind: What it is: "segmenter" or "tracker".
        name: The name that it is registered by.
        arguments: What `make` is called with.
        own: Name of this project's own part of that kind.
        option: What the user gave, for messages.

    Raises:
        InputError: If no package registers that name, or the part cannot be loaded.
    """
    group = f"instant_avatar.{kind}s"
    registered = {point.name: point for point in entry_points(group=group)}
    if name not in registered:
        raise InputError(
            f"{option}: there is no such {kind}; installed are "
            f"{', '.join([own, *registered])}. Others come with packages that have "
            f"an entry point in the group {group!r} (docs/formats.md)."
        )
    try:
        return registered[name].load()(*arguments)
    except Exception as cause:  # code of another package
        raise InputError(f"The {kind} {name!r} could not be loaded: {cause}.") from cause

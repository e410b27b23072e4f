"""Makes trackers by name: this project's own, or one that another package registers."""

from preprocess.plugins import make_plugin
from preprocess.tracking.person_tracker import PersonTracker

DEFAULT_TRACKER = "blazepose"
"""Name of this project's own tracker."""


def make_tracker(name: str = DEFAULT_TRACKER, person: int | None = None) -> PersonTracker:
    """Make this project's tracker, or one of an installed package.

    Another package's entry point NAME = "module:make" lies in the group
    `instant_avatar.trackers`; `make(person)` returns a PersonTracker.

    Args:
        name: The tracker's.
        person: Whom to follow, counted from left to right from 1, in the first frame with that
            many persons; the largest one if it is not given.

    Raises:
        InputError: If no package registers that name, or its tracker cannot be loaded.
    """
    if name == DEFAULT_TRACKER:
        from preprocess.blazepose.blazepose_tracker import BlazePoseTracker

        return BlazePoseTracker(person=person)
    return make_plugin("tracker", name, person, own=DEFAULT_TRACKER, option=f"--tracker {name}")
